// A PLC on node-opcua: a first-order plant with dead time under a PI controller of its own.
// node opcua_plc.js PORT K T D [USER PASSWORD]; prints its endpoint as JSON once it answers. It ends with its standard input.
const opcua = require("node-opcua");
const [port, K, T, D] = process.argv.slice(2, 6).map(Number);
const [user, password] = process.argv.slice(6, 8);
const SCAN_S = 0.02;

const state = { pv: 80, out: 40, sp: 80, mode: 0, kp: 1, ti: 5, td: 0, fault: 0, integral: 40, noise: 1 };
const commands = Array(Math.round(D / SCAN_S)).fill(state.out);
let frozen = new Date();

function scan() {
  if (state.mode === 1) {
    const error = state.sp - state.pv;
    state.integral = Math.min(100, Math.max(0, state.integral + (state.kp / state.ti) * error * SCAN_S));
    state.out = Math.min(100, Math.max(0, state.kp * error + state.integral));
  } else {
    state.integral = state.out - state.kp * (state.sp - state.pv);
  }
  commands.push(state.out);
  state.pv += (K * commands.shift() - state.pv) * (1 - Math.exp(-SCAN_S / T));
  state.noise = (state.noise * 16807) % 2147483647;
  if (state.fault !== 3) frozen = new Date();
}

let begun = process.hrtime.bigint(), scans = 0;
setInterval(() => {
  const due = Number(process.hrtime.bigint() - begun) / 1e9 / SCAN_S;
  for (; scans < due; scans++) scan();
}, 5);

(async () => {
  const server = new opcua.OPCUAServer({
    port,
    resourcePath: "/plc",
    userManager: { isValidUser: (name, word) => name === user && word === password },
    allowAnonymous: user === undefined,
    serverCertificateManager: new opcua.OPCUACertificateManager({
      automaticallyAcceptUnknownCertificate: true,
      rootFolder: process.env.PKI_FOLDER,
    }),
  });
  await server.initialize();
  const space = server.engine.addressSpace.getOwnNamespace();
  const loop = space.addObject({ organizedBy: server.engine.addressSpace.rootFolder.objects, browseName: "TIC101", nodeId: "s=TIC101" });

  function variable(name, dataType, key, writable) {
    const DataType = opcua.DataType[dataType];
    space.addVariable({
      componentOf: loop, browseName: name, nodeId: `s=${name}`, dataType, minimumSamplingInterval: 10,
      accessLevel: writable ? "CurrentRead | CurrentWrite" : "CurrentRead",
      value: {
        timestamped_get: () => {
          const faulty = name === "PV" && state.fault;
          const status = faulty === 1 ? "UncertainSensorNotAccurate" : faulty === 2 ? "BadSensorFailure" : "Good";
          const wobble = name === "PV" ? 0.02 * (state.noise / 2147483647 - 0.5) : 0;
          return new opcua.DataValue({
            value: { dataType: DataType, value: state[key] + wobble },
            statusCode: opcua.StatusCodes[status],
            sourceTimestamp: name === "PV" ? frozen : new Date(),
          });
        },
        timestamped_set: (data) => {
          if (data.value.dataType !== DataType) return opcua.StatusCodes.BadTypeMismatch;
          if (name !== "OUT" || state.mode === 0) state[key] = data.value.value;
          return opcua.StatusCodes.Good;
        },
      },
    });
  }
  variable("PV", "Double", "pv", false);
  variable("OUT", "Float", "out", true);
  variable("SP", "Float", "sp", true);
  variable("MODE", "Int16", "mode", true);
  variable("MODE_RO", "Int16", "mode", false);
  variable("KP", "Float", "kp", true);
  variable("TI", "Float", "ti", true);
  variable("TD", "Float", "td", true);
  variable("FAULT", "Byte", "fault", true);
  for (const [name, mode] of [["SetAuto", 1], ["SetManual", 0]]) {
    space.addMethod(loop, { browseName: name, nodeId: `s=${name}`, inputArguments: [], outputArguments: [] }).bindMethod(
      (_inputs, _context, done) => {
        state.mode = mode;
        done(null, { statusCode: opcua.StatusCodes.Good, outputArguments: [] });
      });
  }
  await server.start();
  console.log(JSON.stringify({ endpoint: `opc.tcp://127.0.0.1:${port}/plc`, namespace: space.index }));
  process.stdin.resume();
  process.stdin.on("end", () => process.exit(0));
})().catch((error) => { console.error(error); process.exit(1); });
