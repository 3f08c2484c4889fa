// A client of a running hand in JavaScript, with nothing but Node: it does an action and tells how it ended.
//
//   rtee run schunk_svh                                          (in another terminal)
//   node examples/client.mjs schunk_svh PinchTight index thumb --intensity 0.6
//
// Written from docs/reference/network.md. Node has no library of Zenoh, so the few messages of its protocol that
// a client needs are here, too. Ctrl-C stops the hand. Exit status: 0 done, 1 not, 2 refused or no hand.

import { createHmac, randomBytes } from "node:crypto";
import { readFileSync } from "node:fs";
import { connect } from "node:net";
import { tmpdir } from "node:os";
import { join } from "node:path";

const fail = (sentence) => {
  console.error(`client: ${sentence}`);
  process.exit(2);
};

// --- CDR: the bytes of ROS 2 messages ---------------------------------------------------------------------------

class Writer {
  bytes = Buffer.from([0, 1, 0, 0]); // little-endian CDR; alignment counts from behind these four bytes
  #put(size, set) {
    const at = Math.ceil((this.bytes.length - 4) / size) * size + 4;
    this.bytes = Buffer.concat([this.bytes, Buffer.alloc(at + size - this.bytes.length)]);
    set(this.bytes, at);
    return this;
  }
  bool = (value) => this.#put(1, (b, at) => b.writeUInt8(value ? 1 : 0, at));
  int32 = (value) => this.#put(4, (b, at) => b.writeInt32LE(value, at));
  float64 = (value) => this.#put(8, (b, at) => b.writeDoubleLE(value, at));
  string(text) {
    const ended = Buffer.from(`${text}\0`, "utf8");
    this.bytes = Buffer.concat([this.int32(ended.length).bytes, ended]);
    return this;
  }
  strings = (list) => list.reduce((writer, text) => writer.string(text), this.int32(list.length));
}

class Reader {
  at = 4;
  constructor(bytes) {
    this.bytes = bytes;
  }
  #take(size) {
    this.at = Math.ceil((this.at - 4) / size) * size + 4 + size;
    return this.at - size;
  }
  bool = () => this.bytes.readUInt8(this.#take(1)) !== 0;
  int32 = () => this.bytes.readInt32LE(this.#take(4));
  float64 = () => this.bytes.readDoubleLE(this.#take(8));
  string() {
    const length = this.int32();
    this.at += length;
    return this.bytes.toString("utf8", this.at - length, this.at - 1);
  }
  list = (read) => Array.from({ length: this.int32() }, () => read.call(this));
}

// --- Zenoh: a session in the mode "client", over a Unix socket or TCP -------------------------------------------

const vle = (value) => Buffer.from(value < 128 ? [value] : [(value % 128) | 128, ...vle(Math.floor(value / 128))]);
const block = (data) => Buffer.concat([vle(Buffer.byteLength(data)), Buffer.from(data)]);
const literal = (key) => Buffer.concat([vle(0), block(key)]);

class Cursor {
  at = 0;
  constructor(bytes) {
    this.bytes = bytes;
  }
  byte = () => this.bytes[this.at++];
  vle() {
    for (let value = 0, scale = 1; ; scale *= 128) {
      const byte = this.byte();
      value += (byte & 127) * scale;
      if (byte < 128) return value;
    }
  }
  take(size) {
    this.at += size;
    return this.bytes.subarray(this.at - size, this.at);
  }
  block = () => this.take(this.vle());
  extensions(header) {
    while (header & 0x80) {
      header = this.byte();
      if ((header & 0x60) === 0x20) this.vle();
      if ((header & 0x60) === 0x40) this.block();
    }
  }
}

class Session {
  #number = randomBytes(3).readUIntLE(0, 3);
  #queries = new Map(); // by number: how to end them, and what has come
  #listeners = new Map(); // by key
  #mine = new Map(); // keys by the numbers that this side has given them
  #theirs = new Map(); // and that the hand has given them
  #ids = 0;
  #rest = Buffer.alloc(0);
  #parts = [];

  static open(endpoint) {
    const [, kind, address] = /^([^/]+)\/(.+)$/.exec(endpoint) ?? fail(`'${endpoint}' is no endpoint`);
    const [, host, port] = /^(.*):(\d+)$/.exec(address) ?? [];
    if (!["unixsock-stream", "tcp"].includes(kind)) fail(`this client knows no ${kind}`);
    const session = new Session();
    return new Promise((opened) => {
      session.opened = () => opened(session);
      session.socket = connect(kind === "tcp" ? { host, port: Number(port) } : { path: address });
      session.socket.on("connect", () =>
        // INIT: protocol 9, "client", an identity of 16 bytes, 32-bit numbers, batches of 65535 bytes.
        session.#batch([0x41, 9, 0xf2, ...randomBytes(16), 0x0a, 0xff, 0xff]));
      session.socket.on("data", (data) => session.#received(data));
      session.socket.on("error", (error) => fail(`no hand at ${endpoint}: ${error.code}`));
      session.socket.on("close", () => fail("the hand has gone"));
    });
  }

  #batch(...parts) {
    const body = Buffer.concat(parts.map((part) => Buffer.from(part)));
    const length = Buffer.alloc(2);
    length.writeUInt16LE(body.length);
    this.socket.write(Buffer.concat([length, body]));
  }

  #send(...parts) {
    this.#batch([0x25], vle(this.#number), ...parts); // FRAME, reliable
    this.#number = (this.#number + 1) % 2 ** 28;
  }

  token = (key) => this.#send([0x1e, 0x26], vle(++this.#ids), literal(key)); // DECLARE a token

  subscribe(key, receive) {
    this.#listeners.set(key, receive);
    this.#send([0x1e, 0x20], vle(++this.#ids), literal(key), [0x1e, 0x42], vle(this.#ids), vle(this.#ids));
    this.#mine.set(this.#ids, key);
  }

  // Return the answer to a query as {ok, payload}; ok is undefined if nobody has answered.
  query(key, payload, attachment) {
    const id = ++this.#ids;
    const question = Buffer.concat([Buffer.from([0]), payload]); // behind its encoding: none
    const body = attachment ? [[0x83, 0xc3], block(question), [0x45], block(attachment)] : [[0x83, 0x43], block(question)];
    this.#send([0x3c], vle(id), literal(key), ...body); // REQUEST with a QUERY
    return new Promise((ended) => this.#queries.set(id, { ended, answer: {} }));
  }

  #received(data) {
    this.#rest = Buffer.concat([this.#rest, data]);
    while (this.#rest.length >= 2 && this.#rest.length >= 2 + this.#rest.readUInt16LE()) {
      const end = 2 + this.#rest.readUInt16LE();
      const batch = new Cursor(this.#rest.subarray(2, end));
      this.#rest = this.#rest.subarray(end);
      this.#transport(batch);
    }
  }

  #transport(batch) {
    const header = batch.byte();
    const kind = header & 0x1f;
    if (kind === 0x01) {
      batch.take(1); // its version
      batch.take((batch.byte() >> 4) + 1); // its identity
      if (header & 0x40) batch.take(3); // sizes
      this.#batch([0x42], vle(10), vle(this.#number), block(batch.block())); // OPEN: 10 s, our number, its cookie
    } else if (kind === 0x02) {
      this.alive = setInterval(() => this.#batch([0x04]), 2500); // KEEP_ALIVE
      this.opened();
    } else if (kind === 0x03) {
      fail("the hand has closed the connection");
    } else if (kind === 0x05 || kind === 0x06) {
      batch.vle();
      batch.extensions(header);
      if (kind === 0x05) return this.#network(batch);
      this.#parts.push(batch.take(batch.bytes.length - batch.at)); // FRAGMENT
      if (!(header & 0x40)) this.#network(new Cursor(Buffer.concat(this.#parts.splice(0))));
    }
  }

  #key(cursor, header) {
    const known = (header & 0x40 ? this.#theirs : this.#mine).get(cursor.vle()) ?? "";
    return known + (header & 0x20 ? cursor.block().toString() : "");
  }

  #put(cursor) {
    const header = cursor.byte(); // PUT
    if (header & 0x20) cursor.vle(), cursor.block(); // its time
    if (header & 0x40 && cursor.vle() & 1) cursor.block(); // its encoding
    cursor.extensions(header);
    return cursor.block();
  }

  #network(cursor) {
    while (cursor.at < cursor.bytes.length) {
      const header = cursor.byte();
      const kind = header & 0x1f;
      if (kind === 0x1d) { // PUSH
        const key = this.#key(cursor, header);
        cursor.extensions(header);
        this.#listeners.get(key)?.(this.#put(cursor));
      } else if (kind === 0x1b) { // RESPONSE
        const query = this.#queries.get(cursor.vle());
        this.#key(cursor, header);
        cursor.extensions(header);
        const body = cursor.byte();
        const ok = (body & 0x1f) === 0x04;
        if (ok && body & 0x20) cursor.byte(); // consolidation
        if (!ok && body & 0x40 && cursor.vle() & 1) cursor.block(); // encoding
        cursor.extensions(body);
        const payload = ok ? this.#put(cursor) : cursor.block();
        if (query) query.answer = { ok, payload };
      } else if (kind === 0x1a) { // RESPONSE_FINAL
        const query = this.#queries.get(cursor.vle());
        cursor.extensions(header);
        query?.ended(query.answer);
      } else if (kind === 0x1e) { // DECLARE: only numbers of keys matter here
        if (header & 0x20) cursor.vle();
        cursor.extensions(header);
        const what = cursor.byte();
        const id = (what & 0x1f) === 0x1a ? 0 : cursor.vle();
        const key = what & 1 || (what & 0x1f) === 0x1a ? "" : this.#key(cursor, what | 0x40);
        if ((what & 0x1f) === 0x00) this.#theirs.set(id, key);
        cursor.extensions(what);
      } else return; // nothing that a client needs
    }
  }
}

// --- the hand ---------------------------------------------------------------------------------------------------

const endpointOf = (hand) => {
  const { RTEE_RUNTIME_DIR: given, XDG_RUNTIME_DIR: user } = process.env;
  const own = given || (user ? join(user, "rtee") : join(tmpdir(), `rtee-${process.getuid()}`));
  for (const folder of given ? [own] : [own, "/run/rtee"]) {
    try {
      return JSON.parse(readFileSync(join(folder, `${hand}.json`), "utf8")).endpoints[0];
    } catch {} // not there, or just ending
  }
  return fail(`no hand '${hand}' runs here; start it with 'rtee run ${hand}'`);
};

const reply = ({ ok, payload }) => {
  if (ok === undefined) fail("nobody has answered");
  const reader = new Reader(payload);
  const [accepted, error, reason, text] = [reader.bool(), reader.string(), reader.string(), reader.string()];
  return accepted ? text : fail(`${error}: ${reason}`);
};

const words = process.argv.slice(2);
const option = words.indexOf("--intensity");
const intensity = option < 0 ? 1 : Number(words.splice(option, 2)[1]);
const [hand, action, ...elements] = words;
if (!action || Number.isNaN(intensity)) fail("node client.mjs HAND ACTION [ELEMENT…] [--intensity SHARE]");

const endpoint = process.env.RTEE_CONNECT || endpointOf(hand);
const way = endpoint.startsWith("unixsock") ? "here" : "plain";
const session = await Session.open(endpoint);
const client = `node-${process.pid}`;
const token = randomBytes(16).toString("hex");
session.token(`rtee/${hand}/clients/${token}`);
const introduced = reply(await session.query(`rtee/${hand}/hello/${way}`, new Writer().string(client).string(token).bytes));
const secret = Buffer.from(introduced.split(" ")[0], "hex");
let number = 0;

const request = async (group, name, payload) => {
  const signed = Buffer.concat([Buffer.from(`${name} ${++number} `), payload]);
  const signature = createHmac("sha256", secret).update(signed).digest("hex").slice(0, 32);
  return reply(await session.query(`rtee/${hand}/${group}/${name}`, payload, `${number} ${client} ${signature}`));
};

process.on("SIGINT", async () => {
  await session.query(`rtee/${hand}/stop/stop`, new Writer().string(client).string("").bytes);
  fail("stopped");
});

const goalId = randomBytes(8).toString("hex");
const ended = new Promise((resolve) => {
  session.subscribe(`rtee/${hand}/results`, (payload) => {
    const reader = new Reader(payload);
    reader.int32(), reader.int32(), reader.string(), reader.float64(); // header, time
    const result = { goal: reader.string(), action: reader.string() };
    for (const name of ["reached", "stalled", "grasped"]) result[name] = reader.bool();
    result.fingers = reader.list(reader.string);
    for (const name of ["preempted", "cancelled", "timedOut", "aborted"]) result[name] = reader.bool();
    result.reason = reader.string();
    if (result.goal === goalId) resolve(result);
  });
});

const goal = new Writer().int32(0).int32(0).string("").float64(0); // header, time: for recordings
goal.string(goalId).string(client).string(action).string("").strings(elements).float64(intensity);
goal.strings([]).int32(0).float64(0.01).float64(1).float64(NaN).string("both"); // efforts, tolerance, speed, timeout
goal.float64(NaN).float64(NaN).bool(false).float64(NaN).float64(0.005).float64(0.005); // opening, force, grasp
goal.strings([]).strings([]).bool(false).float64(NaN); // contacts, touch, largest force
await request("control", "do", goal.bytes);
const result = await ended;
console.log(JSON.stringify(result));
process.exit(result.reached || result.grasped ? 0 : 1); // the hand sees the token vanish
