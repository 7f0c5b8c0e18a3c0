// A small client in another language: Node.js, the dialect handbook over TCP.
// node client.mjs HOST PORT trigger [N] | switch ID | watch N
import net from "node:net";

const [host, port, verb, number] = process.argv.slice(2);
const SECONDS = Number(process.env.CLIENT_SECONDS ?? 1.5);
const ID = { connect: 1, disconnect: 2, status: 0x12, result: 0x20, query: 0x30, change: 0x31,
  trigger: 0x40, start: 0x41, stop: 0x42 };
const BUSY = 0x10, RUNNING = 0x80, OVERTRIGGERED = 0x100, WAITING = 0x200;

let buffer = Buffer.alloc(0), status = 0, active = 0, results = [], wake = () => {};
const answers = new Map();

function fail(text) {
  console.error(text);
  process.exit(1);
}

if (!["trigger", "switch", "watch"].includes(verb)) process.exit(77);

const socket = net.connect({ host, port: Number(port), noDelay: true });
socket.on("error", (error) => fail(error.message));
socket.on("close", () => fail("the camera closed the connection"));
socket.on("data", (data) => {
  buffer = Buffer.concat([buffer, data]);
  while (buffer.length >= 12) {
    const length = buffer.readUInt32LE(4);
    if (buffer.readUInt32LE(0) !== 0x42565350 || length > 65536) fail("no frame");
    if (buffer.length < 12 + length) break;
    const id = buffer.readUInt32LE(8), body = buffer.subarray(12, 12 + length);
    buffer = buffer.subarray(12 + length);
    if (id === ID.status) status = body.readUInt32LE(0);
    else if (id === ID.result) results.push([body.readUInt32LE(0), body.subarray(4)]);
    else answers.set(id, body);
    wake();
  }
});

function send(id, ...words) {
  const frame = Buffer.alloc(12 + 4 * words.length);
  [0x42565350, 4 * words.length, id, ...words].forEach((word, n) => frame.writeUInt32LE(word, 4 * n));
  socket.write(frame);
}

async function until(condition, what) {
  const end = Date.now() + 1000 * SECONDS;
  while (!condition()) {
    if (Date.now() > end) fail(`no ${what}`);
    await new Promise((resolve) => {
      const timer = setTimeout(resolve, end - Date.now() + 1);
      wake = () => { clearTimeout(timer); resolve(); };
    });
  }
}

async function ask(id, ...words) {
  answers.delete(id);
  send(id, ...words);
  await until(() => answers.has(id), `answer to ${id}`);
  return answers.get(id);
}

async function trigger() {
  await until(() => status & WAITING, "readiness");
  results = [];
  status &= ~WAITING; // it rises again behind this inspection
  send(ID.trigger);
  const ours = () => results.find(([application]) => application === active);
  await until(() => ours() || status & OVERTRIGGERED, "result");
  if (!ours()) fail("overtriggered");
  console.log(ours()[1].toString("hex"));
}

await ask(ID.connect);
active = (await ask(ID.query)).readUInt32LE(0);
if (verb === "watch") {
  await until(() => results.length >= Number(number), "results");
  for (const [, data] of results.slice(0, number)) console.log(JSON.stringify({ data: data.toString("hex") }));
} else if (verb === "switch") {
  send(ID.stop);
  await until(() => !(status & RUNNING), "stop");
  const answer = await ask(ID.change, Number(number));
  if (answer.readUInt32LE(0)) fail("the camera refuses");
  active = answer.readUInt32LE(4);
  await until(() => !(status & BUSY), "end of BUSY");
  send(ID.start);
  await trigger();
} else {
  for (let n = 0; n < Number(number ?? 1); n++) await trigger();
}
send(ID.disconnect);
socket.removeAllListeners("close");
socket.end();
