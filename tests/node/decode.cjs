// Decode every message of an MCAP file by Foxglove's libraries, and print the number of each topic as JSON.
// node decode.cjs FILE.mcap, with @mcap/core and @mcap/support in node_modules beside the working folder.
const { createRequire } = require("module");
const load = createRequire(process.cwd() + "/");
const { McapIndexedReader } = load("@mcap/core");
const { loadDecompressHandlers, protobufFromBinaryDescriptor } = load("@mcap/support");
const fs = require("fs");

function decoder(channel, schema) {
  if (channel.messageEncoding === "protobuf") {
    const type = protobufFromBinaryDescriptor(schema.data).lookupType(schema.name);
    return (data) => type.toObject(type.decode(data), { defaults: true });
  }
  if (channel.messageEncoding === "json") {
    return (data) => JSON.parse(new TextDecoder().decode(data));
  }
  throw new Error(`${channel.topic} is encoded as ${channel.messageEncoding}`);
}

async function main(path) {
  const data = fs.readFileSync(path);
  const readable = {
    size: async () => BigInt(data.length),
    read: async (offset, length) => data.subarray(Number(offset), Number(offset) + Number(length)),
  };
  const decompressHandlers = await loadDecompressHandlers();
  const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
  const parsers = new Map();
  const counts = {};
  for await (const message of reader.readMessages()) {
    const channel = reader.channelsById.get(message.channelId);
    if (!parsers.has(channel.id)) {
      const schema = reader.schemasById.get(channel.schemaId);
      parsers.set(channel.id, { schema: schema?.name ?? "", deserialize: decoder(channel, schema) });
    }
    const parser = parsers.get(channel.id);
    const decoded = parser.deserialize(message.data);
    if (decoded == null || typeof decoded !== "object" || Object.keys(decoded).length === 0) {
      throw new Error(`an empty message on ${channel.topic}`);
    }
    const known = (counts[channel.topic] ??= { schema: parser.schema, encoding: channel.messageEncoding, messages: 0 });
    known.messages += 1;
  }
  console.log(JSON.stringify(counts));
}

main(process.argv[2]).catch((error) => {
  console.error(String(error));
  process.exit(1);
});
