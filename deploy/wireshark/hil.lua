-- Wireshark dissector of hil-runtime's datagrams, version 2 of the wire format
-- (gateways/protocol/src/wire.rs and body.rs). It recognises them by their magic number on any UDP
-- port and judges nothing that the gateways would judge from state.
--
-- Use: copy to ~/.local/lib/wireshark/plugins/, or: tshark -X lua_script:deploy/wireshark/hil.lua

local hil = Proto("hil", "hil-runtime datagram")

local HEADER_BYTES = 72
local TAG_BYTES = 16
local UNKNOWN_TIME = "-9223372036854775808"
local kinds = {
    [1] = "DATA", [2] = "SYNC_REQ", [3] = "SYNC_RSP",
    [4] = "HELLO", [5] = "HELLO_ACK", [6] = "BYE",
    [7] = "KEY_REQ", [8] = "KEY_ANS", [9] = "PIECE_ACK",
}
local statuses = {
    [0] = "accepted", [1] = "channels differ", [2] = "one shared-memory domain",
    [3] = "unknown flow", [4] = "versions differ", [5] = "greet again",
}
local sources = { [0] = "application", [1] = "kernel software", [2] = "hardware" }

local f = {
    magic = ProtoField.string("hil.magic", "Magic"),
    version = ProtoField.uint8("hil.version", "Version"),
    kind = ProtoField.uint8("hil.kind", "Kind", base.DEC, kinds),
    flags = ProtoField.uint16("hil.flags", "Flags", base.HEX),
    authenticated = ProtoField.bool("hil.flags.authenticated", "Sealed", 16, nil, 0x0001),
    session = ProtoField.uint32("hil.session", "Session", base.HEX),
    channel = ProtoField.uint16("hil.channel", "Channel or flow"),
    header_len = ProtoField.uint16("hil.header_len", "Header length"),
    sequence = ProtoField.uint64("hil.sequence", "Sequence"),
    type_hash = ProtoField.uint64("hil.type_hash", "Hash of the message type, or digest of the flow", base.HEX),
    published = ProtoField.int64("hil.published_ns", "Published (sender's monotonic, ns)"),
    handed = ProtoField.int64("hil.handed_ns", "Handed to kernel (sender's monotonic, ns)"),
    follow_up_sequence = ProtoField.uint32("hil.follow_up.sequence", "Follow-up for sequence, low half"),
    follow_up_delta = ProtoField.uint32("hil.follow_up.delta_ns", "Follow-up: handed to transmit stamp (ns)"),
    total_len = ProtoField.uint32("hil.total_len", "Message or body length"),
    fragment_index = ProtoField.uint16("hil.fragment.index", "Fragment"),
    fragment_count = ProtoField.uint16("hil.fragment.count", "Fragments"),
    epoch = ProtoField.uint32("hil.epoch", "Epoch (producer's start)", base.HEX),
    reserved = ProtoField.bytes("hil.reserved", "Reserved"),
    generation = ProtoField.uint8("hil.seal.generation", "Generation of the key, low 8 bits"),
    number = ProtoField.uint32("hil.seal.number", "Number under the key"),
    sealed = ProtoField.bytes("hil.seal.payload", "Sealed payload"),
    salt = ProtoField.bytes("hil.seal.salt", "Salt"),
    code = ProtoField.bytes("hil.seal.code", "Code (HMAC-SHA256)"),
    payload = ProtoField.bytes("hil.payload", "Payload"),
    tag = ProtoField.bytes("hil.tag", "Authentication tag"),

    hello_domain = ProtoField.bytes("hil.hello.domain", "Shared-memory domain"),
    hello_clock = ProtoField.uint64("hil.hello.clock_id", "Clock", base.HEX),
    hello_channels = ProtoField.uint16("hil.hello.channel_count", "Channels of the flow"),
    hello_flow = ProtoField.string("hil.hello.flow_name", "Flow name"),

    ack_status = ProtoField.uint8("hil.ack.status", "Status", base.DEC, statuses),
    ack_session = ProtoField.uint32("hil.ack.session", "Answering session", base.HEX),
    ack_clock = ProtoField.uint64("hil.ack.clock_id", "Clock", base.HEX),
    ack_domain = ProtoField.bytes("hil.ack.domain", "Shared-memory domain"),
    ack_answers = ProtoField.int64("hil.ack.answers_handed_ns", "Answers the datagram handed at (ns)"),

    t1 = ProtoField.int64("hil.sync.t1_ns", "t1: request handed (requester's monotonic, ns)"),
    t2 = ProtoField.int64("hil.sync.t2_ns", "t2: request arrived (responder's monotonic, ns)"),
    t3 = ProtoField.int64("hil.sync.t3_ns", "t3: response handed (responder's monotonic, ns)"),
    t2_source = ProtoField.uint8("hil.sync.t2_source", "Source of t2", base.DEC, sources),
}
hil.fields = f

local e = {
    version = ProtoExpert.new("hil.expert.version", "Version is not 2: only the first 16 bytes are known",
        expert.group.UNDECODED, expert.severity.WARN),
    malformed = ProtoExpert.new("hil.expert.malformed", "Lengths or reserved bytes are not as they must be",
        expert.group.MALFORMED, expert.severity.ERROR),
}
hil.experts = e

local function dissect_hello(body, tree)
    if body:len() < 42 then return false end
    tree:add(f.hello_domain, body(0, 16))
    tree:add_le(f.hello_clock, body(16, 8))
    tree:add_le(f.hello_channels, body(24, 2))
    tree:add(f.reserved, body(26, 14))
    local length = body(40, 1):uint()
    if length == 0 or 41 + length ~= body:len() then return false end
    tree:add(f.hello_flow, body(41, length))
    return true
end

local function dissect_hello_ack(body, tree)
    if body:len() ~= 40 then return false end
    tree:add(f.ack_status, body(0, 1))
    tree:add(f.reserved, body(1, 3))
    tree:add_le(f.ack_session, body(4, 4))
    tree:add_le(f.ack_clock, body(8, 8))
    tree:add(f.ack_domain, body(16, 16))
    tree:add_le(f.ack_answers, body(32, 8))
    return true
end

local function dissect_sync_response(body, tree)
    if body:len() ~= 40 then return false end
    tree:add_le(f.t1, body(0, 8))
    tree:add_le(f.t2, body(8, 8))
    tree:add_le(f.t3, body(16, 8))
    tree:add(f.t2_source, body(24, 1))
    tree:add(f.reserved, body(25, 15))
    return true
end

local function dissect_body(kind, body, tree)
    if kind == 1 then
        if body:len() > 0 then tree:add(f.payload, body) end
        return true
    elseif kind == 2 then
        tree:add(f.reserved, body)
        return body:len() == 40
    elseif kind == 3 then
        return dissect_sync_response(body, tree)
    elseif kind == 4 then
        return dissect_hello(body, tree)
    elseif kind == 5 then
        return dissect_hello_ack(body, tree)
    elseif kind == 9 then
        tree:add_le(f.ack_answers, body)
        return body:len() == 8
    end
    return false
end

function hil.dissector(buffer, pinfo, root)
    if buffer:len() < 16 then return 0 end
    pinfo.cols.protocol = "HIL"
    local tree = root:add(hil, buffer())
    local kind = buffer(5, 1):uint()
    local name = kinds[kind] or ("kind " .. kind)
    tree:add(f.magic, buffer(0, 4))
    tree:add(f.version, buffer(4, 1))
    tree:add(f.kind, buffer(5, 1))
    tree:add_le(f.flags, buffer(6, 2)):add_le(f.authenticated, buffer(6, 2))
    tree:add_le(f.session, buffer(8, 4))
    tree:add_le(f.channel, buffer(12, 2))
    tree:add_le(f.header_len, buffer(14, 2))
    local channel = buffer(12, 2):le_uint()
    local about = (kind == 1 or kind == 6) and "channel" or "flow"
    if buffer(4, 1):uint() ~= 2 then
        tree:add_proto_expert_info(e.version)
        pinfo.cols.info = name .. " " .. about .. " " .. channel .. " of another version"
        return buffer:len()
    end
    if buffer:len() < HEADER_BYTES then
        -- A probe keeps no less than the header, so this is not one of ours.
        tree:add_proto_expert_info(e.malformed)
        return buffer:len()
    end
    local sequence = buffer(16, 8):le_uint64()
    tree:add_le(f.sequence, buffer(16, 8))
    tree:add_le(f.type_hash, buffer(24, 8))
    local published = tree:add_le(f.published, buffer(32, 8))
    if tostring(buffer(32, 8):le_int64()) == UNKNOWN_TIME then published:append_text(" (unknown)") end
    tree:add_le(f.handed, buffer(40, 8))
    if buffer(52, 4):le_uint() ~= 0xffffffff then
        tree:add_le(f.follow_up_sequence, buffer(48, 4))
        tree:add_le(f.follow_up_delta, buffer(52, 4))
    end
    tree:add_le(f.total_len, buffer(56, 4))
    tree:add_le(f.fragment_index, buffer(60, 2))
    tree:add_le(f.fragment_count, buffer(62, 2))
    tree:add_le(f.epoch, buffer(64, 4))
    local is_sealed = bit.band(buffer(6, 2):le_uint(), 1) == 1
    if is_sealed then
        tree:add(f.generation, buffer(7, 1))
        tree:add_le(f.number, buffer(68, 4))
    else
        tree:add(f.reserved, buffer(68, 4))
    end

    local body_end = buffer:len()
    -- A capture may hold less than the wire did: then the end of the buffer is no tag.
    local is_cut = buffer:len() < buffer:reported_len()
    local is_key_exchange = kind == 7 or kind == 8
    if is_sealed and not is_key_exchange and not is_cut and body_end >= HEADER_BYTES + TAG_BYTES then
        body_end = body_end - TAG_BYTES
        tree:add(f.tag, buffer(body_end, TAG_BYTES))
    end
    local is_sound = true
    if is_key_exchange then
        is_sound = is_sealed and buffer:len() == HEADER_BYTES + 48
        if is_sound then
            tree:add(f.salt, buffer(HEADER_BYTES, 16))
            tree:add(f.code, buffer(HEADER_BYTES + 16, 32))
        end
    elseif is_sealed then
        -- Without the key nobody can say what it is, so it is not dissected as what it is not.
        if body_end > HEADER_BYTES then tree:add(f.sealed, buffer(HEADER_BYTES, body_end - HEADER_BYTES)) end
    elseif body_end > HEADER_BYTES then
        is_sound = dissect_body(kind, buffer(HEADER_BYTES, body_end - HEADER_BYTES), tree)
    elseif kind ~= 1 and kind ~= 6 then
        is_sound = false
    end
    if buffer(14, 2):le_uint() ~= HEADER_BYTES then is_sound = false end
    if not is_sealed and buffer(68, 4):le_uint() ~= 0 then is_sound = false end
    if not is_sound and not is_cut then tree:add_proto_expert_info(e.malformed) end

    local info = name .. " " .. about .. " " .. channel .. " seq " .. tostring(sequence)
    local count = buffer(62, 2):le_uint()
    if count > 1 then info = info .. " piece " .. (buffer(60, 2):le_uint() + 1) .. "/" .. count end
    if is_sealed then info = info .. ", sealed" end
    pinfo.cols.info = info
    return buffer:len()
end

local function heuristic(buffer, pinfo, root)
    if buffer:len() < 16 or buffer(0, 4):string() ~= "HILG" then return false end
    hil.dissector(buffer, pinfo, root)
    return true
end

hil:register_heuristic("udp", heuristic)
