
-- What is above is data; below is what reads frames with it. It runs in the Lua 5.1 to 5.4 of
-- Wireshark 3.6 to 4.x: no bit operators, no integer division, and no goto.

local BOUND = 10000  -- requests of a stream that wait for their answer
local SHOWN = 32  -- bytes of data in the info column

local bvs = Proto("bvs", "Balluff BVS smart camera")

-- ------------------------------------------------------------------ fields

local all_fields, all_experts = {}, {}

local function field(kind, name, text, ...)
  local one = ProtoField[kind]("bvs." .. name, text, ...)
  table.insert(all_fields, one)
  return one
end

local function finding(name, text, group, severity)
  local one = ProtoExpert.new("bvs." .. name, text, group, severity)
  table.insert(all_experts, one)
  return one
end

local function label(name)
  return (name:sub(1, 1):upper() .. name:sub(2):gsub("_", " "))
end

local f = {
  dialect = field("string", "dialect", "Dialect"),
  sender = field("string", "sender", "Sender"),
  message = field("string", "message", "Message"),
  magic = field("bytes", "magic", "Magic number"),
  length = field("uint32", "length", "Length"),
  id = field("uint32", "id", "Message id", base.HEX, IDS),
  payload = field("bytes", "payload", "Payload"),
  surplus = field("bytes", "surplus", "Surplus"),
  skipped = field("bytes", "skipped", "Skipped"),
  others = field("uint32", "status.others", "Other bits", base.HEX),
  text = field("string", "data.text", "Data as text"),
  verdict = field("string", "verdict", "Verdict"),
  answer_in = field("framenum", "answer_in", "Answer in", base.NONE, frametype.RESPONSE),
  answer_to = field("framenum", "answer_to", "Answer to", base.NONE, frametype.REQUEST),
  time = field("relative_time", "time", "Time since the request"),
}

local SHAPES = {  -- of fields that are more than a decimal number
  data = {"bytes"},
  status = {"uint32", base.HEX},
  code = {"uint32", base.HEX},
  endian = {"uint32", base.DEC, {[0] = "little", [1] = "big"}},
}

local decoded = {}  -- fields of bodies, by their names
for name, wire in pairs(FIELDS) do
  local shape = SHAPES[name] or {wire == "data" and "bytes" or "uint32"}
  decoded[name] = field(shape[1], name, label(name), shape[2], shape[3])
end

local bits = {}  -- of the status, by their names
for _, name in ipairs(STATUSES) do
  bits[name] = field("bool", "status." .. name, label(name))
end

local e = {
  malformed = finding("malformed", "The body is shorter than its message",
    expert.group.MALFORMED, expert.severity.ERROR),
  no_frame = finding("no_frame", "These bytes make no frame",
    expert.group.MALFORMED, expert.severity.ERROR),
  unfinished = finding("unfinished", "The rest of the frame is missing",
    expert.group.MALFORMED, expert.severity.ERROR),
  long_body = finding("long_body", "The body is longer than documented",
    expert.group.PROTOCOL, expert.severity.WARN),
  unknown_id = finding("unknown_id", "No message has this id",
    expert.group.UNDECODED, expert.severity.WARN),
  refused = finding("refused", "The camera has not done what it was asked for",
    expert.group.RESPONSE_CODE, expert.severity.NOTE),
  unnamed_bits = finding("unnamed_bits", "No document names these bits",
    expert.group.PROTOCOL, expert.severity.NOTE),
}

bvs.fields = all_fields
bvs.experts = all_experts

-- ------------------------------------------------------------------ preferences

local choices = {{1, "auto", 0}}
local quirk_texts = {}
for number, dialect in ipairs(DIALECTS) do
  table.insert(choices, {number + 1, dialect.name, number})
  for _, quirk in ipairs(dialect.quirks) do
    quirk_texts[quirk.name] = dialect.name .. ": " .. quirk.about
  end
end

bvs.prefs.port = Pref.uint("Port of the camera", PORT, "Over TCP and UDP; 0 for none")
bvs.prefs.dialect = Pref.enum("Dialect", 0,
  "auto: the magic number tells, and without one which messages the camera sends", choices, false)
for name, text in pairs(quirk_texts) do
  bvs.prefs["quirk_" .. name] = Pref.bool("Quirk " .. name, false, text)
end
bvs.prefs.max_length = Pref.uint("Largest payload", MAX_LENGTH,
  "Bytes; a frame that announces more is taken for none")

-- ------------------------------------------------------------------ dialects

local dialects = {}  -- by name
for _, dialect in ipairs(DIALECTS) do
  dialects[dialect.name] = dialect
  dialect.lead = math.floor(#dialect.magic / 2)  -- bytes of the magic number
  dialect.header = dialect.lead + 2 * dialect.number
end

local function merged(one, other)
  local result = {}
  for _, entries in ipairs({one, other}) do
    for key, value in pairs(entries) do
      result[key] = value
    end
  end
  return result
end

local variants = {}  -- dialects with quirks, by their labels

-- Return a dialect with those of the quirks that it knows.
local function variant(name, quirks)
  local found, names = dialects[name], {}
  local text = name
  for _, quirk in ipairs(found.quirks) do
    if quirks[quirk.name] then
      table.insert(names, quirk)
      text = text .. (#names == 1 and " with quirk " or ", ") .. quirk.name
    end
  end
  if not variants[text] then
    local one = merged(found, {label = text})
    for _, quirk in ipairs(names) do
      one.messages = {
        client = merged(one.messages.client, quirk.messages.client),
        camera = merged(one.messages.camera, quirk.messages.camera),
      }
      if next(quirk.codes) then
        one.codes = quirk.codes
      end
    end
    variants[text] = one
  end
  return variants[text]
end

local with_magic, without_magic = {}, {}  -- the variants that may be spoken

local function set_candidates()
  local quirks = {}
  for name, _ in pairs(quirk_texts) do
    quirks[name] = bvs.prefs["quirk_" .. name] or nil
  end
  with_magic, without_magic = {}, {}
  local taken = {}
  local function add(name, wanted)
    local one = variant(name, wanted)
    if not taken[one.label] then
      taken[one.label] = true
      table.insert(one.magic ~= "" and with_magic or without_magic, one)
    end
  end
  local pinned = DIALECTS[bvs.prefs.dialect]
  if pinned then
    add(pinned.name, quirks)
    return
  end
  for _, name_and_quirks in ipairs(TRIED_TOGETHER) do
    local wanted = merged(quirks, {})
    for number = 2, #name_and_quirks do
      wanted[name_and_quirks[number]] = true
    end
    add(name_and_quirks[1], wanted)
  end
end

local function means(dialect, code)
  return dialect.codes[code] or {"not documented", "refused"}
end

-- Whether a body of so many bytes can be this message.
local function fits(dialect, sender, id, size)
  local row = dialect.messages[sender][id]
  if not row then
    return false
  end
  return size == row.size or (row.data and size > row.size)
    or (row.code_alone and size == dialect.word)
end

-- ------------------------------------------------------------------ streams

local streams, links = {}, {}
local TCP = 2  -- pinfo.port_type

function bvs.init()
  streams, links = {}, {}
  set_candidates()
end

-- tcp.stream would tell streams apart, but fields are not at hand in every pass
local function stream_of(pinfo)
  local source = tostring(pinfo.src) .. " " .. pinfo.src_port
  local target = tostring(pinfo.dst) .. " " .. pinfo.dst_port
  local first, second = source, target
  if first > second then
    first, second = second, first
  end
  local key = table.concat({tostring(pinfo.port_type), first, second}, " ")
  local stream = streams[key]
  if not stream then
    stream = {candidates = without_magic, open = {}, waiting = 0}
    streams[key] = stream
  end
  return stream, source, target
end

local function only_one(port, pinfo)
  if port and (pinfo.src_port == port) ~= (pinfo.dst_port == port) then
    return pinfo.src_port == port and "camera" or "client"
  end
  return nil
end

-- Return who has sent this: by the port; else by what it is; else the client spoke first.
local function sender_of(stream, pinfo, dialect, id, size)
  local _, source, target = stream_of(pinfo)
  if not stream.camera then
    local sender = only_one(bvs.prefs.port, pinfo)
    if not sender and dialect then
      local client = fits(dialect, "client", id, size)
      if client ~= fits(dialect, "camera", id, size) then
        sender = client and "client" or "camera"
      end
    end
    sender = sender or only_one(tonumber(pinfo.match), pinfo) or "client"
    stream.camera = sender == "camera" and source or target
  end
  return stream.camera == source and "camera" or "client"
end

-- Keep the dialects that a frame can be of.
local function learn(stream, sender, id, size)
  if #stream.candidates == 1 then
    return
  end
  local left = {}
  for _, one in ipairs(stream.candidates) do
    local row = one.messages[sender][id]
    if row and row.name == "GetStatus" then
      stream.asked = true  -- it tells nothing: this is how a client finds out the dialect
      return
    end
    -- behind the answer to Connect, and nobody has asked for it
    local by_itself = row and row.name == "StatusReport" and stream.fresh and not stream.asked
    if fits(one, sender, id, size) and (one.unasked_status or not by_itself) then
      table.insert(left, one)
    end
  end
  stream.candidates = #left > 0 and left or stream.candidates
end

-- Link answers to their requests; an answer says no more than its id.
local function link(stream, pinfo, key, sender, id, row)
  if sender == "client" then
    if row.name == "Connect" then
      stream.open, stream.waiting = {}, 0
    end
    if row.answered and stream.waiting < BOUND then
      stream.open[id] = stream.open[id] or {}
      table.insert(stream.open[id], {key = key, frame = pinfo.number, time = pinfo.rel_ts})
      stream.waiting = stream.waiting + 1
    end
  elseif stream.open[id] and #stream.open[id] > 0 then
    local request = table.remove(stream.open[id], 1)
    stream.waiting = stream.waiting - 1
    links[request.key] = {answer_in = pinfo.number}
    local seconds = pinfo.rel_ts - request.time
    local whole = math.floor(seconds)
    links[key] = {
      answer_to = request.frame,
      time = NSTime.new(whole, math.floor((seconds - whole) * 1e9 + 0.5)),
    }
  end
end

-- ------------------------------------------------------------------ bodies

-- Return where a mask's bits stand in a word, as Wireshark draws it.
local function picture(word, mask, size)
  local text = ""
  for bit = 8 * size - 1, 0, -1 do
    local weight = 2 ^ bit
    local inside = math.floor(mask / weight) % 2 == 1
    text = text .. (inside and (math.floor(word / weight) % 2 == 1 and "1" or "0") or ".")
      .. (bit % 4 == 0 and bit > 0 and " " or "")
  end
  return text
end

local function add_status(tree, range, word, dialect)
  local names, rest = {}, word
  local function bit(mask, name, value)
    local item = tree:add(bits[name], range, value)
    item:set_text(string.format("%s = %s: %s", picture(word, mask, dialect.word), label(name),
      value and "True" or "False"))
    if value then
      table.insert(names, name:upper())
    end
  end
  local function taken(mask)
    local set = math.floor(word / mask) % 2 == 1
    rest = set and rest - mask or rest
    return set
  end
  for _, name in ipairs(dialect.status.always) do
    tree:add(bits[name], range, true):set_generated()
    table.insert(names, name:upper())
  end
  for _, one in ipairs(dialect.status.named) do
    bit(one[1], one[2], taken(one[1]))
  end
  for _, one in ipairs(dialect.status.inverted) do
    bit(one[1], one[2], not taken(one[1]))
  end
  if rest ~= 0 then
    tree:add(f.others, range, rest):add_proto_expert_info(e.unnamed_bits)
    table.insert(names, string.format("0x%x", rest))
  end
  local text = #names > 0 and table.concat(names, "|") or "0"
  tree:append_text(" (" .. text .. ")")
  return text
end

local function add_code(tree, range, code, dialect)
  local meaning = means(dialect, code)
  tree:append_text(" (" .. meaning[1] .. ")")
  local verdict = tree:add(f.verdict, range, meaning[2])
  verdict:set_generated()
  if meaning[2] ~= "done" then
    verdict:add_proto_expert_info(e.refused, meaning[1])
  end
end

local function add_data(tree, range)
  local size = range:len()
  local hex = range(0, math.min(size, SHOWN)):bytes():tohex(true)
  local text = range:raw():gsub("%z+$", "")
  if text ~= "" and not text:find("[^\32-\126]") then
    tree:add(f.text, range, text):set_generated()
  end
  return hex .. (size > SHOWN and "..." or "")
end

-- Add the fields of a body; return them for the info column.
local function add_body(tree, body, row, dialect)
  local offset, texts = 0, {}
  for _, one in ipairs(row.fields) do
    local name, wire = one[1], one[2]
    local size = wire == "data" and body:len() - offset or wire == "uint32" and 4 or dialect.word
    if offset + size > body:len() or (wire == "data" and size == 0) then
      break
    end
    local range = body(offset, size)
    local text
    if wire == "data" then
      text = add_data(tree:add(decoded[name], range), range)
    else
      local value = row.big_endian and range:uint() or range:le_uint()
      local item = row.big_endian and tree:add(decoded[name], range)
        or tree:add_le(decoded[name], range)
      text = string.format("%d", value)
      if name == "status" then
        text = add_status(item, range, value, dialect)
      elseif name == "code" then
        add_code(item, range, value, dialect)
        text = string.format("0x%02x", value)
      end
    end
    table.insert(texts, name .. "=" .. text)
    offset = offset + size
  end
  return table.concat(texts, ", ")
end

-- ------------------------------------------------------------------ frames

-- Add one whole frame; return its text for the info column.
local function add_frame(stream, pinfo, tree, range, head, key)
  local dialect, id, size = head.dialect, head.id, head.size
  local sender = sender_of(stream, pinfo, dialect, id, size)
  if not pinfo.visited then
    if not head.magic then
      learn(stream, sender, id, size)
      stream.known = true
    elseif sender == "camera" then
      stream.magic = true
    end
    local row = stream.candidates[1] and stream.candidates[1].messages[sender][id]
    stream.fresh = sender == "camera" and row and row.name == "ConnectAnswer"
      or (stream.fresh and sender == "client")
  end
  if not head.magic then
    dialect = stream.candidates[1]
  end
  local row = dialect.messages[sender][id]
  if row and not pinfo.visited then
    link(stream, pinfo, key, sender, id, row)
  end
  local name = row and row.name or "UnknownMessage"
  local title = row and row.title or "unknown"
  local frame = tree:add(bvs, range)
  frame:append_text(string.format(", %s, %s: %s", dialect.label, sender, title))
  frame:add(f.dialect, range(0, 0), dialect.label):set_generated()
  frame:add(f.sender, range(0, 0), sender):set_generated()
  frame:add(f.message, range(0, 0), name):set_generated()
  if dialect.lead > 0 then
    frame:add(f.magic, range(0, dialect.lead))
  end
  local id_item
  for number, what in ipairs(dialect.id_first and {"id", "length"} or {"length", "id"}) do
    local offset = dialect.lead + (number - 1) * dialect.number
    local item = frame:add_le(f[what], range(offset, dialect.number))
    id_item = what == "id" and item or id_item
  end
  id_item:set_text(string.format("Message id: 0x%02x (%s)", id, title))
  local known = links[key]
  if known then
    for _, what in ipairs({"answer_in", "answer_to", "time"}) do
      if known[what] then
        frame:add(f[what], range(0, 0), known[what]):set_generated()
      end
    end
  end
  local text = ""
  if size > 0 then
    local body = range(dialect.header, size)
    if not row then
      frame:add(f.payload, body)
      text = string.format("id=0x%x, payload=%s", id, add_data(frame, body))
    else
      text = add_body(frame, body, row, dialect)
    end
  elseif not row then
    text = string.format("id=0x%x", id)
  end
  if not row then
    id_item:add_proto_expert_info(e.unknown_id)
  elseif not fits(dialect, sender, id, size) then
    if size < row.size then
      frame:add_proto_expert_info(e.malformed,
        string.format("%s came with %d bytes, it needs %d", name, size, row.size))
      name = "[malformed] " .. name
    else
      frame:add(f.surplus, range(dialect.header + row.size, size - row.size))
        :add_proto_expert_info(e.long_body)
    end
  end
  return name .. "(" .. text .. ")"
end

-- Return the header at an offset: dialect, id, size, whether it has a magic number. Without one: nil
-- and "more" where bytes are missing, nil and "none" where no frame begins here.
local function head_at(stream, tvb, offset)
  local left = tvb:len() - offset
  local dialect, partial
  for _, one in ipairs(with_magic) do
    local length = math.min(one.lead, left)
    if tvb(offset, length):bytes():tohex(true) == one.magic:sub(1, 2 * length) then
      if length == one.lead then
        dialect = one
      else
        partial = true
      end
    end
  end
  local magic = dialect ~= nil
  if not dialect and not stream.magic then
    dialect = stream.candidates[1]
  end
  if (partial and not stream.known) or (dialect and left < dialect.header) then
    return nil, "more"
  end
  if not dialect then
    return nil, "none"
  end
  local start = offset + dialect.lead
  local first = tvb(start, dialect.number):le_uint()
  local second = tvb(start + dialect.number, dialect.number):le_uint()
  local id = dialect.id_first and first or second
  local size = (dialect.id_first and second or first) - dialect.length_includes
  if size < 0 or size > bvs.prefs.max_length then
    return nil, "none"
  end
  if not magic and not stream.known and #stream.candidates > 1 then
    -- nothing has told yet that these are our frames
    local fitting = false
    for _, one in ipairs(stream.candidates) do
      fitting = fitting or one.messages.client[id] or one.messages.camera[id]
    end
    if not fitting then
      return nil, "none"
    end
  end
  return {dialect = dialect, id = id, size = size, magic = magic}
end

-- Return where the next magic number begins behind an offset, or the end.
local function next_magic(tvb, offset)
  local data, found = tvb:raw(offset + 1), nil
  for _, one in ipairs(with_magic) do
    local magic = one.magic:gsub("..", function(two)
      return string.char(tonumber(two, 16))
    end)
    local position = data:find(magic, 1, true)
    if position and (not found or position < found) then
      found = position
    end
  end
  return found and offset + found or tvb:len()
end

local info_of = nil  -- number of the packet whose info column is ours

local function show(pinfo, texts)
  if #texts == 0 then
    return
  end
  pinfo.cols.protocol = "BVS"
  local text = table.concat(texts, "; ")
  pinfo.cols.info:set(info_of == pinfo.number and "; " .. text or text)
  pinfo.cols.info:fence()  -- a packet may end one frame and begin the next
  info_of = pinfo.number
end

local function dissect(tvb, pinfo, tree, datagram)
  local stream = stream_of(pinfo)
  local length = tvb:len()
  local whole = length == tvb:reported_len()
  local offset, texts = 0, {}
  local function refuse(size, finding_of, text)
    local item = tree:add(bvs, tvb(offset, size))
    item:add(f.skipped, tvb(offset, size)):add_proto_expert_info(finding_of, text)
    table.insert(texts, "[" .. text .. "] " .. tvb(offset, math.min(size, SHOWN)):bytes():tohex(true))
    offset = offset + size
  end
  while offset < length do
    local head, reason = head_at(stream, tvb, offset)
    local size = head and head.dialect.header + head.size
    if (head and offset + size > length) or reason == "more" then
      if datagram or not whole or pinfo.can_desegment == 0 then
        refuse(length - offset, e.unfinished,
          whole and "the rest of the frame is missing" or "cut in the capture")
      else
        pinfo.desegment_offset = offset
        pinfo.desegment_len = head and offset + size - length or DESEGMENT_ONE_MORE_SEGMENT
        break
      end
    elseif not head then
      refuse((datagram and length or next_magic(tvb, offset)) - offset, e.no_frame,
        "these bytes make no frame")
    elseif datagram and size < length then
      refuse(length, e.no_frame, "a datagram is one frame, this one has more bytes")
    else
      local key = string.format("%d %d %d %d", pinfo.number, tvb:offset(), length, offset)
      table.insert(texts, add_frame(stream, pinfo, tree, tvb(offset, size), head, key))
      offset = offset + size
    end
  end
  show(pinfo, texts)
  return length
end

-- ------------------------------------------------------------------ registration in Wireshark

local tables = {tcp = DissectorTable.get("tcp.port"), udp = DissectorTable.get("udp.port")}
local registered = 0

function bvs.dissector(tvb, pinfo, tree)
  return dissect(tvb, pinfo, tree, pinfo.port_type ~= TCP)
end

-- Frames with a magic number are known on any port.
local function look(tvb, pinfo, tree)
  for _, one in ipairs(with_magic) do
    if tvb:len() >= one.header and tvb(0, one.lead):bytes():tohex(true) == one.magic then
      pinfo.conversation = bvs
      dissect(tvb, pinfo, tree, pinfo.port_type ~= TCP)
      return true
    end
  end
  return false
end

local function listen()
  if registered == bvs.prefs.port then
    return
  end
  for _, ports in pairs(tables) do
    if registered > 0 then
      ports:remove(registered, bvs)
    end
    if bvs.prefs.port > 0 then
      ports:add(bvs.prefs.port, bvs)
    end
  end
  registered = bvs.prefs.port
end

function bvs.prefs_changed()
  set_candidates()
  listen()
end

set_candidates()
listen()
for name, ports in pairs(tables) do
  ports:add_for_decode_as(bvs)
  bvs:register_heuristic(name, look)
end
