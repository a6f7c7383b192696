// Balances a pole with the decisions of a server, on one stream.
//
// usage: node examples/call.js [HOST:PORT]
//
// Needs `npm install @grpc/grpc-js @grpc/proto-loader`. The .proto file is all that it takes from this repository.
'use strict';

const grpc = require('@grpc/grpc-js');
const protoLoader = require('@grpc/proto-loader');

const PROTO = 'spikeserve/v1/policy_service.proto';
const definition = protoLoader.loadSync(PROTO, {includeDirs: [`${__dirname}/../proto`], keepCase: true, longs: Number});
const {PolicyService} = grpc.loadPackageDefinition(definition).spikeserve.v1;

// Moves Gymnasium's CartPole by one step of 20 ms.
function step([x, velocity, angle, turning], action) {
  const [sine, cosine] = [Math.sin(angle), Math.cos(angle)];
  const force = (action === 1 ? 10 : -10) + 0.05 * turning ** 2 * sine;
  const angular = (9.8 * sine - cosine * force / 1.1) / (0.5 * (4 / 3 - 0.1 * cosine ** 2 / 1.1));
  const linear = (force - 0.05 * angular * cosine) / 1.1;
  return [x + 0.02 * velocity, velocity + 0.02 * linear, angle + 0.02 * turning, turning + 0.02 * angular];
}

function play(client, sessionId) {
  const stream = client.ActStream();
  let [state, steps] = [[0.01, -0.02, 0.03, 0.04], 0];
  const send = () => stream.write({session_id: sessionId, step: steps, observation: state, reward: steps ? 1 : 0});
  stream.on('data', (answer) => {
    if (answer.error) throw new Error(answer.error.message);
    state = step(state, answer.action.discrete);
    steps += 1;
    if (steps < 500 && Math.abs(state[0]) < 2.4 && Math.abs(state[2]) < 0.21) return send();
    console.log(`return ${steps}`);
    stream.end();
  });
  stream.on('end', () => client.CloseSession({session_id: sessionId}, () => client.close()));
  send();
}

const client = new PolicyService(process.argv[2] || '127.0.0.1:50051', grpc.credentials.createInsecure());
client.OpenSession({policy: 'cartpole'}, (error, opened) => {
  if (error) throw error;
  play(client, opened.session_id);
});
