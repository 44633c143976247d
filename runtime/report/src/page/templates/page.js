// The page is whole without this. It adds a cursor over all panels of one axis, zoom by dragging, and
// channels that can be hidden, and unfolds for paper what is folded. It fetches nothing and keeps nothing.
(function () {
  "use strict";
  var unfolded = [];
  window.addEventListener("beforeprint", function () {
    document.querySelectorAll("details:not([open])").forEach(function (one) {
      one.open = true;
      unfolded.push(one);
    });
  });
  window.addEventListener("afterprint", function () {
    unfolded.forEach(function (one) { one.open = false; });
    unfolded = [];
  });

  var plots = JSON.parse(document.getElementById("plots").textContent);
  var NS = "http:" + "//www.w3.org/2000/svg";

  function make(parent, name, attributes, text) {
    var node = parent.namespaceURI === NS ? document.createElementNS(NS, name) : document.createElement(name);
    Object.keys(attributes || {}).forEach(function (key) { node.setAttribute(key, attributes[key]); });
    if (text !== undefined) { node.textContent = text; }
    parent.appendChild(node);
    return node;
  }

  function words(value, unit) {
    if (unit === "share") { return (value * 100).toPrecision(3) + " %"; }
    if (unit === "s") {
      var size = Math.abs(value);
      if (size < 1e-6) { return (value * 1e9).toFixed(0) + " ns"; }
      if (size < 1e-3) { return (value * 1e6).toPrecision(3) + " µs"; }
      if (size < 1) { return (value * 1e3).toPrecision(3) + " ms"; }
      return value.toPrecision(4) + " s";
    }
    var text = String(Number(value.toPrecision(4)));
    return unit === "count" || unit === "1" || unit === "" ? text : text + " " + unit;
  }

  function Chart(svg, plot) {
    var chart = this;
    chart.svg = svg; chart.plot = plot; chart.axis = plot.axis;
    chart.left = Number(svg.dataset.left); chart.right = Number(svg.dataset.right);
    chart.bottom = Number(svg.dataset.bottom);
    chart.from = plot.from_s; chart.until = plot.until_s;
    chart.zoomed = svg.querySelectorAll(".zoom");
    chart.ticks = svg.querySelector(".time-axis");
    chart.firstTicks = chart.ticks.cloneNode(true);
    chart.line = make(svg, "line", { "class": "cursor off", y1: 0, y2: chart.bottom });
    chart.chosen = make(svg, "rect", { "class": "chosen off", y: 0, height: chart.bottom });
    var figure = svg.closest("figure");
    chart.tools = make(figure, "div", { "class": "tools" });
    chart.readout = make(figure, "div", { "class": "readout" });
    figure.insertBefore(chart.tools, figure.children[1]);
    make(chart.readout, "div", { "class": "head" }, "Point at the figure to read values; drag to zoom, double-click to see all.");
    var reset = make(chart.tools, "button", { type: "button" }, "whole run");
    reset.addEventListener("click", function () { zoomAll(chart.axis, plot.from_s, plot.until_s); });
    chart.listen();
  }

  Chart.prototype.timeAt = function (event) {
    var box = this.svg.getBoundingClientRect();
    var x = (event.clientX - box.left) / box.width * this.svg.viewBox.baseVal.width;
    var part = (x - this.left) / (this.right - this.left);
    return this.from + Math.min(1, Math.max(0, part)) * (this.until - this.from);
  };

  Chart.prototype.place = function (time) {
    return this.left + (time - this.from) / (this.until - this.from) * (this.right - this.left);
  };

  Chart.prototype.listen = function () {
    var chart = this, begun = null;
    chart.svg.addEventListener("pointerdown", function (event) {
      if (event.pointerType === "mouse") { begun = chart.timeAt(event); event.preventDefault(); }
      cursorAll(chart.axis, chart.timeAt(event));
    });
    chart.svg.addEventListener("pointermove", function (event) {
      var time = chart.timeAt(event);
      cursorAll(chart.axis, time);
      if (begun !== null && event.buttons) { chart.choose(begun, time); }
    });
    window.addEventListener("pointerup", function (event) {
      if (begun === null) { return; }
      var time = chart.timeAt(event), first = Math.min(begun, time), last = Math.max(begun, time);
      begun = null;
      chart.chosen.classList.add("off");
      if (last - first > (chart.until - chart.from) * 0.01) { zoomAll(chart.axis, first, last); }
    });
    chart.svg.addEventListener("pointercancel", function () { begun = null; chart.chosen.classList.add("off"); });
    chart.svg.addEventListener("dblclick", function () { zoomAll(chart.axis, chart.plot.from_s, chart.plot.until_s); });
    chart.svg.setAttribute("tabindex", "0");
    chart.svg.addEventListener("keydown", function (event) {
      var step = (chart.until - chart.from) / 200, now = chart.time === undefined ? chart.from : chart.time;
      if (event.key === "ArrowRight") { cursorAll(chart.axis, Math.min(chart.until, now + step)); }
      else if (event.key === "ArrowLeft") { cursorAll(chart.axis, Math.max(chart.from, now - step)); }
      else if (event.key === "Escape") { zoomAll(chart.axis, chart.plot.from_s, chart.plot.until_s); }
      else { return; }
      event.preventDefault();
    });
  };

  Chart.prototype.choose = function (begun, time) {
    var a = this.place(Math.min(begun, time)), b = this.place(Math.max(begun, time));
    this.chosen.setAttribute("x", a);
    this.chosen.setAttribute("width", b - a);
    this.chosen.classList.remove("off");
  };

  Chart.prototype.cursor = function (time) {
    var chart = this, plot = chart.plot, x = chart.place(time);
    chart.time = time;
    chart.line.classList.toggle("off", time < chart.from || time > chart.until);
    chart.line.setAttribute("x1", x);
    chart.line.setAttribute("x2", x);
    chart.readout.textContent = "";
    make(chart.readout, "div", { "class": "head" }, "at " + time.toFixed(3) + " s");
    plot.panels.forEach(function (panel) {
      var part = (time - plot.from_s) / (plot.until_s - plot.from_s);
      panel.series.forEach(function (one) {
        var index = Math.min(one.high.length - 1, Math.floor(part * one.high.length));
        var high = one.high[index], low = one.low.length ? one.low[index] : high;
        if (hidden[one.channel]) { return; }
        var row = make(chart.readout, "div");
        make(row, "span", {}, panel.series.length > 1 || one.channel ? panel.title + ", " + one.name : panel.title);
        var text = high === null || high === undefined ? "none" : words(high, panel.unit);
        if (high !== null && low !== high && low !== null) { text = words(low, panel.unit) + " to " + text; }
        make(row, "b", {}, text);
      });
    });
  };

  Chart.prototype.zoom = function (from, until) {
    var chart = this, whole = chart.plot.until_s - chart.plot.from_s, scale = whole / (until - from);
    chart.from = from; chart.until = until;
    var shift = chart.left - (chart.left + (from - chart.plot.from_s) / whole * (chart.right - chart.left)) * scale;
    chart.zoomed.forEach(function (group) { group.setAttribute("transform", "matrix(" + scale + " 0 0 1 " + shift + " 0)"); });
    if (scale < 1.0001) {
      chart.zoomed.forEach(function (group) { group.removeAttribute("transform"); });
      chart.ticks.replaceChildren.apply(chart.ticks, Array.prototype.slice.call(chart.firstTicks.cloneNode(true).childNodes));
      return;
    }
    chart.ticks.textContent = "";
    var rough = (until - from) / 8, base = Math.pow(10, Math.floor(Math.log10(rough)));
    var step = [1, 2, 5, 10].map(function (f) { return f * base; }).find(function (s) { return s >= rough; });
    var digits = Math.max(0, Math.ceil(-Math.log10(step) - 1e-9));
    for (var at = Math.ceil(from / step) * step; at <= until; at += step) {
      var x = chart.place(at);
      make(chart.ticks, "line", { "class": "grid", x1: x, x2: x, y1: chart.bottom - 4, y2: chart.bottom });
      make(chart.ticks, "text", { "class": "faint", x: x, y: chart.bottom + 16, "text-anchor": "middle" }, at.toFixed(digits));
    }
    make(chart.ticks, "text", { "class": "faint", x: (chart.left + chart.right) / 2, y: chart.bottom + 33, "text-anchor": "middle" }, "seconds, enlarged");
  };

  var charts = [], hidden = {};
  function ofAxis(axis) { return charts.filter(function (chart) { return chart.axis === axis; }); }
  function cursorAll(axis, time) { ofAxis(axis).forEach(function (chart) { chart.cursor(time); }); }
  function zoomAll(axis, from, until) { ofAxis(axis).forEach(function (chart) { chart.zoom(from, until); }); }

  function channelTools(chart) {
    var names = [];
    chart.plot.panels.forEach(function (panel) {
      panel.series.forEach(function (one) { if (one.channel && names.indexOf(one.channel) < 0) { names.push(one.channel); } });
    });
    if (names.length < 2) { return; }
    names.forEach(function (name) {
      var label = make(chart.tools, "label"), box = make(label, "input", { type: "checkbox" });
      box.checked = true;
      make(label, "span", {}, name);
      box.addEventListener("change", function () {
        hidden[name] = !box.checked;
        chart.svg.closest("article").querySelectorAll("[data-channel]").forEach(function (node) {
          if (node.dataset.channel === name) { node.classList.toggle("off", !box.checked); }
        });
      });
    });
  }

  document.querySelectorAll("svg[data-axis]").forEach(function (svg) {
    var plot = plots[svg.id];
    if (!plot) { return; }
    var chart = new Chart(svg, plot);
    charts.push(chart);
    channelTools(chart);
  });
}());
