// A client of node-opcua, which another team has written after the same standard: it starts a job
// at a camera, hears its event, asks for its result, and prints what it got as JSON.
import { createRequire } from "node:module";
const require = createRequire(process.argv[3] + "/");
const { AttributeIds, ClientMonitoredItem, ClientSubscription, DataType, OPCUAClient,
  TimestampsToReturn, coerceNodeId, constructEventFilter, promoteOpaqueStructure } = require("node-opcua-client");

const [, , url, , camera] = process.argv;
const client = OPCUAClient.create({ endpointMustExist: false, connectionStrategy: { maxRetry: 5 } });
await client.connect(url);
const session = await client.createSession();
const spaces = await session.readNamespaceArray();
const vision = spaces.indexOf("http://opcfoundation.org/UA/MachineVision");
const own = spaces.indexOf("urn:smartcam:outlets:opcua");
const node = (path) => `ns=${own};s=${camera}${path ? "." + path : ""}`;

const names = ["JobId", "MeasId", "ResultState", "CreationTime", "IsPartial", "IsSimulated",
  "ExternalRecipeId", "InternalRecipeId", "ResultId", "ResultContent"];
const subscription = await ClientSubscription.create(session, {
  requestedPublishingInterval: 20, requestedLifetimeCount: 6000, requestedMaxKeepAliveCount: 100,
  maxNotificationsPerPublish: 100, publishingEnabled: true, priority: 1,
});
const filter = constructEventFilter(["EventType", ...names.map((name) => `${vision}:${name}`)]);
const item = await ClientMonitoredItem.create(subscription,
  { nodeId: node(""), attributeId: AttributeIds.EventNotifier },
  { filter, queueSize: 100, samplingInterval: 0, discardOldest: false }, TimestampsToReturn.Both);
const heard = new Promise((resolve) => {
  item.on("changed", (fields) => {
    if (fields[0].value.value === 1024) resolve(fields.slice(1));
  });
});

const structure = (number, id) =>
  session.constructExtensionObject(coerceNodeId(`ns=${vision};i=${number}`), { id });
const ids = [[3015, "node"], [3004, "part"], [3002, ""], [3003, ""]];
const inputArguments = [];
for (const [number, id] of ids) {
  inputArguments.push({ dataType: DataType.ExtensionObject, value: await structure(number, id) });
}
inputArguments.push({ dataType: DataType.Variant, arrayType: 1, value: [] });
const machine = "VisionStateMachine.AutomaticModeStateMachine";
const [started] = await session.call([{
  objectId: node(machine), methodId: node(`${machine}.StartSingleJob`), inputArguments,
}]);
const fields = await heard;
const [asked] = await session.call([{
  objectId: node("ResultManagement"), methodId: node("ResultManagement.GetResultById"),
  inputArguments: [
    { dataType: DataType.ExtensionObject, value: fields[8].value },
    { dataType: DataType.Int32, value: 0 },
  ],
}]);
for (const one of [started, asked]) {
  await promoteOpaqueStructure(session, one.outputArguments.map((value) => ({ value })));
}
await promoteOpaqueStructure(session, fields.map((value) => ({ value })));
const result = asked.outputArguments[1].value;
await promoteOpaqueStructure(session, result.resultContent.map((value) => ({ value })));
const plain = (value) => (value && value.toJSON ? value.toJSON() : value);
console.log(JSON.stringify({
  started: started.outputArguments.map((one) => plain(one.value)),
  event: Object.fromEntries(names.map((name, place) => [name, plain(fields[place].value)])),
  content: result.resultContent.map((one) => plain(one.value)),
  meas: plain(result.measId),
}));
await session.close();
await client.disconnect();
