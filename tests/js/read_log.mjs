// Reads a log with @mcap/core, decodes every message and validates it against its own schema with ajv.
// Also compares the Foxglove schemas in the log with the official ones. Prints one JSON document; any failure is an exception.
import { open } from "node:fs/promises";
import { isDeepStrictEqual } from "node:util";
import { McapIndexedReader } from "@mcap/core";
import zstd from "@foxglove/wasm-zstd";
import Ajv from "ajv";
import foxglove from "@foxglove/schemas/jsonschema.js";

await zstd.isLoaded;
const file = await open(process.argv[2], "r");
const { size } = await file.stat();
const readable = {
  size: async () => BigInt(size),
  read: async (offset, length) => {
    const buffer = new Uint8Array(Number(length));
    const { bytesRead } = await file.read(buffer, 0, Number(length), Number(offset));
    if (bytesRead !== Number(length)) throw new Error(`short read at ${offset}`);
    return buffer;
  },
};
const reader = await McapIndexedReader.Initialize({
  readable,
  decompressHandlers: { zstd: (buffer, unpacked) => zstd.decompress(buffer, Number(unpacked)) },
});

// prose and the order of keywords do not matter
function bare(schema) {
  if (Array.isArray(schema)) return schema.map(bare);
  if (schema === null || typeof schema !== "object") return schema;
  const kept = Object.entries(schema).filter(([key, value]) => !((key === "description" && typeof value === "string") || key === "$comment"));
  return Object.fromEntries(kept.map(([key, value]) => [key, key === "required" && Array.isArray(value) ? [...value].sort() : bare(value)]));
}

const ajv = new Ajv({ strict: false });
const text = new TextDecoder();
const validators = new Map();
const unlikeOfficial = [];
for (const schema of reader.schemasById.values()) {
  const parsed = JSON.parse(text.decode(schema.data));
  validators.set(schema.id, ajv.compile(parsed));
  const [family, name] = schema.name.split(".");
  if (family === "foxglove" && !isDeepStrictEqual(bare(parsed), bare(foxglove[name]))) unlikeOfficial.push(schema.name);
}

const counts = {};
let lastTime = -1n;
for await (const message of reader.readMessages()) {
  const channel = reader.channelsById.get(message.channelId);
  const validate = validators.get(channel.schemaId);
  if (!validate(JSON.parse(text.decode(message.data)))) {
    throw new Error(`${channel.topic} at ${message.logTime}: ${ajv.errorsText(validate.errors)}`);
  }
  if (message.logTime < lastTime) throw new Error(`time runs backwards on ${channel.topic}`);
  lastTime = message.logTime;
  counts[channel.topic] = (counts[channel.topic] ?? 0) + 1;
}
const metadata = [];
for await (const record of reader.readMetadata()) metadata.push(record.name);
const attachments = [];
for await (const record of reader.readAttachments()) attachments.push(record.name);
console.log(JSON.stringify({ counts, metadata, attachments, chunks: reader.chunkIndexes.length, unlikeOfficial }));
