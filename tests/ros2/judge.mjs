// Another implementation of CDR reads each message and writes it again.
//
// Standard input has a line of JSON for each: {"text": ..., "bytes": base64};
// standard output one for each: {"bytes": base64} or {"error": ...}.
import { createRequire } from "node:module";
import { createInterface } from "node:readline";

const require = createRequire(process.argv[2] + "/");
const { parse } = require("@foxglove/rosmsg");
const { MessageReader, MessageWriter } = require("@foxglove/rosmsg2-serialization");

const made = new Map();

function both(text) {
  let found = made.get(text);
  if (found === undefined) {
    const definitions = parse(text, { ros2: true });
    found = [new MessageReader(definitions), new MessageWriter(definitions)];
    made.set(text, found);
  }
  return found;
}

for await (const line of createInterface({ input: process.stdin })) {
  let answer;
  try {
    const { text, bytes } = JSON.parse(line);
    const [reader, writer] = both(text);
    const message = reader.readMessage(Buffer.from(bytes, "base64"));
    answer = { bytes: Buffer.from(writer.writeMessage(message)).toString("base64") };
  } catch (error) {
    answer = { error: String(error) };
  }
  process.stdout.write(JSON.stringify(answer) + "\n");
}
