// The Foxglove WebSocket protocol as far as the page needs it: topics in JSON, and parameters.
// Connects again by itself; keeps no message.

const PROTOCOL = "foxglove.sdk.v1";
const MESSAGE_DATA = 1;
const HEADER_BYTES = 1 + 4 + 8;
const FIRST_RETRY_MS = 500;
const LAST_RETRY_MS = 4000;

export class Socket {
  // handlers: opened(info), message(topic, time_s, bytes), parameters(list), lost(),
  // status(level, text). `wanted` says of a topic whether the page reads it.
  constructor(url, wanted, handlers) {
    this.url = url;
    this.wanted = wanted;
    this.handlers = handlers;
    this.retryMs = FIRST_RETRY_MS;
    this.connect();
  }

  connect() {
    this.topics = new Map();
    this.subscriptions = new Map();
    this.nextId = 1;
    const socket = new WebSocket(this.url, PROTOCOL);
    socket.binaryType = "arraybuffer";
    socket.onmessage = (event) => this.receive(event.data);
    socket.onclose = () => this.retry();
    this.socket = socket;
  }

  retry() {
    this.handlers.lost();
    setTimeout(() => this.connect(), this.retryMs);
    this.retryMs = Math.min(this.retryMs * 2, LAST_RETRY_MS);
  }

  send(message) {
    if (this.socket.readyState !== WebSocket.OPEN) return false;
    this.socket.send(JSON.stringify(message));
    return true;
  }

  receive(data) {
    if (data instanceof ArrayBuffer) return this.receiveBinary(data);
    const message = JSON.parse(data);
    switch (message.op) {
      case "serverInfo":
        this.retryMs = FIRST_RETRY_MS;
        this.info = message;
        this.handlers.opened(message);
        if (this.can("parameters")) this.send({ op: "getParameters", parameterNames: [], id: "all" });
        break;
      case "advertise":
        this.subscribe(message.channels);
        break;
      case "unadvertise":
        this.forget(message.channelIds);
        break;
      case "parameterValues":
        this.listed(message);
        break;
      case "status":
        this.handlers.status(message.level, message.message);
        break;
      default: // other operations are for other viewers
    }
  }

  receiveBinary(data) {
    const view = new DataView(data);
    if (view.byteLength < HEADER_BYTES || view.getUint8(0) !== MESSAGE_DATA) return;
    const topic = this.subscriptions.get(view.getUint32(1, true));
    const time_s = Number(view.getBigUint64(5, true)) / 1e9;
    if (topic) this.handlers.message(topic, time_s, new Uint8Array(data, HEADER_BYTES));
  }

  subscribe(channels) {
    const added = [];
    for (const channel of channels) {
      if (channel.encoding !== "json" || !this.wanted(channel.topic)) continue;
      const id = this.nextId++;
      this.topics.set(channel.id, id);
      this.subscriptions.set(id, channel.topic);
      added.push({ id, channelId: channel.id });
    }
    if (added.length > 0) this.send({ op: "subscribe", subscriptions: added });
  }

  forget(channelIds) {
    for (const channelId of channelIds) {
      const id = this.topics.get(channelId);
      this.topics.delete(channelId);
      this.subscriptions.delete(id);
    }
  }

  can(capability) {
    return Boolean(this.info?.capabilities?.includes(capability));
  }

  listed(message) {
    if (message.id === "all" && this.can("parametersSubscribe")) {
      const parameterNames = message.parameters.map((parameter) => parameter.name);
      if (parameterNames.length > 0) this.send({ op: "subscribeParameterUpdates", parameterNames });
    }
    this.handlers.parameters(message.parameters);
  }

  // True when the request left; the server's answer comes to `parameters` under the same id.
  setParameter(parameter, id) {
    return this.send({ op: "setParameters", parameters: [parameter], id });
  }
}
