// Runs one case of the interoperability tests with grpc-js, the implementation for Node.js. Ends with status 0 if the
// server behaves as expected.
//
// usage: node client.js CASE ADDRESS PROTO_FOLDER [CA_FILE [CERTIFICATE KEY]]
'use strict';

const assert = require('node:assert');
const fs = require('node:fs');
const grpc = require('@grpc/grpc-js');
const protoLoader = require('@grpc/proto-loader');

const [, , caseName, address, protoFolder, authority, certificate, key] = process.argv;
const OBSERVATION = [0.01, -0.02, 0.03, 0.1];
const MESSAGE_LIMIT = 4194304;

function load(file) {
  const options = {includeDirs: [protoFolder], keepCase: true, longs: Number, defaults: true};
  return grpc.loadPackageDefinition(protoLoader.loadSync(file, options));
}

function credentials() {
  const read = (path) => (path ? fs.readFileSync(path) : null);
  return authority
      ? grpc.credentials.createSsl(read(authority), read(key), read(certificate))
      : grpc.credentials.createInsecure();
}

function connect(Client, options = {}) {
  return new Client(address, credentials(), {'grpc.max_receive_message_length': -1, ...options});
}

const Policy = load('spikeserve/v1/policy_service.proto').spikeserve.v1.PolicyService;
const Health = load('grpc/health/v1/health.proto').grpc.health.v1.Health;
const policy = connect(Policy);

// Makes a unary call. Returns a promise of the response; it fails with the error of grpc-js.
function call(client, method, request, options = {}, metadata = new grpc.Metadata()) {
  return new Promise((resolve, reject) => {
    const deadline = Date.now() + 30000;
    client[method](request, metadata, {deadline, ...options},
                   (error, response) => (error ? reject(error) : resolve(response)));
  });
}

// Waits for the end of a stream. Returns its status and messages.
function finish(stream, onMessage = () => {}) {
  return new Promise((resolve) => {
    const messages = [];
    stream.on('data', (message) => {
      messages.push(message);
      onMessage(messages.length, message);
    });
    stream.on('error', () => {});  // 'status' follows
    stream.on('status', (status) => resolve({status, messages}));
  });
}

async function openSession() {
  return (await call(policy, 'OpenSession', {policy: 'cartpole'})).session_id;
}

async function fails(promise, code) {
  await assert.rejects(promise, (error) => {
    assert.strictEqual(error.code, code, error.message);
    return true;
  });
}

const cases = {
  async empty_unary() {
    assert((await call(policy, 'ListPolicies', {})).policies.length > 0);
  },

  async large_unary() {
    const requests = Array(1000).fill({session_id: 'x'.repeat(3000)});
    assert.strictEqual((await call(policy, 'ActBatch', {requests})).results.length, requests.length);
    const tooLong = {requests: [{session_id: 'x'.repeat(MESSAGE_LIMIT)}]};
    await fails(call(policy, 'ActBatch', tooLong), grpc.status.RESOURCE_EXHAUSTED);
  },

  async ping_pong() {
    const session_id = await openSession();
    const stream = policy.ActStream();
    const send = (step) => stream.write({session_id, step, observation: OBSERVATION});
    send(0);
    const {status, messages} =
        await finish(stream, (count) => (count < 100 ? send(count) : stream.end()));
    assert.strictEqual(status.code, grpc.status.OK);
    assert.deepStrictEqual(messages.map((message) => message.step), [...Array(100).keys()]);
  },

  async half_close() {
    const session_id = await openSession();
    const stream = policy.ActStream();
    for (let step = 0; step < 1000; ++step) stream.write({session_id, step, observation: OBSERVATION});
    stream.end();
    const {status, messages} = await finish(stream);
    assert.strictEqual(status.code, grpc.status.OK);
    assert.strictEqual(messages.length, 1000);
  },

  async empty_stream() {
    const stream = policy.ActStream();
    stream.end();
    assert.strictEqual((await finish(stream)).status.code, grpc.status.OK);
  },

  async cancel_after_begin() {
    const stream = policy.ActStream();
    stream.cancel();
    assert.strictEqual((await finish(stream)).status.code, grpc.status.CANCELLED);
    await openSession();
  },

  async cancel_after_first_response() {
    const session_id = await openSession();
    const stream = policy.ActStream();
    stream.write({session_id, step: 0, observation: OBSERVATION});
    const {status, messages} = await finish(stream, () => stream.cancel());
    assert.strictEqual(status.code, grpc.status.CANCELLED);
    assert.strictEqual(messages.length, 1);
    await openSession();
  },

  async timeout() {
    const stream = policy.ActStream({deadline: Date.now() + 200});
    assert.strictEqual((await finish(stream)).status.code, grpc.status.DEADLINE_EXCEEDED);
  },

  async metadata() {
    const metadata = new grpc.Metadata();
    metadata.add('x-text', 'a, b');
    metadata.add('x-text', 'c');
    metadata.add('x-bytes-bin', Buffer.from([...Array(256).keys()]));
    metadata.add('x-bytes-bin', Buffer.from([0]));
    assert((await call(policy, 'ListPolicies', {}, {}, metadata)).policies.length > 0);
  },

  async status_message() {
    const admin = connect(load('spikeserve/v1/policy_admin.proto').spikeserve.v1.PolicyAdmin);
    await assert.rejects(call(admin, 'LoadPolicy', {policy: 'cartpole', version: 9}), (error) => {
      assert.strictEqual(error.code, grpc.status.NOT_FOUND);
      assert(error.details.startsWith(process.env.EXPECTED_MESSAGE), error.details);
      return true;
    });
  },

  async unimplemented() {
    const Unknown = grpc.makeGenericClientConstructor({
      method: {...Policy.service.ListPolicies, path: '/spikeserve.v1.PolicyService/NoSuchMethod'},
      service: {...Policy.service.ListPolicies, path: '/no.such.Service/Method'},
    });
    const unknown = connect(Unknown);
    await fails(call(unknown, 'method', {}), grpc.status.UNIMPLEMENTED);
    await fails(call(unknown, 'service', {}), grpc.status.UNIMPLEMENTED);
  },

  async compression() {
    const gzip = connect(Policy, {'grpc.default_compression_algorithm': 2});
    const answer = await call(gzip, 'OpenSession', {policy: 'cartpole', routing_key: 'x'.repeat(256)});
    assert(answer.session_id.length > 0);
  },

  async concurrent() {
    const answers = await Promise.all(
        Array.from({length: 1000}, () => call(policy, 'ListPolicies', {})));
    assert(answers.every((answer) => answer.policies.length > 0));
  },

  async health() {
    const health = connect(Health);
    assert.strictEqual((await call(health, 'Check', {})).status, 1);
    await fails(call(health, 'Check', {service: 'no.such.Service'}), grpc.status.NOT_FOUND);
    const watch = health.Watch({});
    const {status, messages} = await finish(watch, () => watch.cancel());
    assert.strictEqual(status.code, grpc.status.CANCELLED);
    assert.strictEqual(messages[0].status, 1);
  },
};

cases[caseName]().then(() => process.exit(0), (error) => {
  console.error(error);
  process.exit(1);
});
