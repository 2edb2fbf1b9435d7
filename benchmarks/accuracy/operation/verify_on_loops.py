"""Verification on loops of the simulator, with right and wrong models: what passes, what goes back, how far the PV got.

    python benchmarks/accuracy/operation/verify_on_loops.py [--plants N] [--jobs N]

Plants are drawn at random (seeded) and simulated by `autotuner_sim`, which imports nothing of the product, under the
controller of a simulated device with gains designed for a model that is right, has half or twice the gain, or half the
dead time, or is right but hides a valve that sticks over 80 % of the output's last move (with a tenth of the noise:
more, through the derivative, keeps such a valve moving). The product's own verifier makes its step in virtual time: set
point moved inside PV limits two steps wide, gains put back unless it passes. Asked of the device in the end: its gains,
set point, mode and output.
"""

import argparse
import asyncio
import math

import async_solipsism
from joblib import Parallel, delayed

from autotuner.application.computing.compute_pool import InPlace
from autotuner.configuration import LoopTable
from autotuner.control.devices.plugins import make_backend
from autotuner.control.verification.verification_run import Claim, VerificationRun
from autotuner.control.verification.verify import Verifier
from autotuner.core.design import PidSettings, design, held_by_device
from autotuner.ports import AUTO, OUTPUT, SET_POINT
from benchmarks.accuracy.operation.verification import STICKING, WRONG, plants

NOISE, STEP = 0.05, 2.0
QUIETER = 0.1
PV, OUTPUT_AT_REST, ROOM = 80.0, 40.0, 2.0 * STEP
FORM, DERIVATIVE_FILTER = "ideal", 8.0
"""What the simulated device has: the ideal form, and its own filter of the derivative, `Td/N`."""
OLD = {"kp": 0.1, "ti": 100.0, "td": 0.0}


def loop_of(truth, effects, noise, seed):
    """Return the configuration of a simulated loop at rest in auto."""
    sample_time_s = round(min(truth.D / 5.0, (truth.D + truth.parameters().get("T", 0.0)) / 50.0), 3)
    device = {
        "plant": {"structure": truth.structure, **truth.parameters()},
        "output0": OUTPUT_AT_REST,
        "pv0": PV,
        "noise": noise,
        "seed": seed,
        "scan_s": sample_time_s,
        "effects": effects,
        "gains": OLD,
    }
    limits = {"output": [0.0, 100.0], "pv": [PV - ROOM, PV + ROOM]}
    return LoopTable.model_validate({
        "driver": "simulated",
        "sample_time_s": sample_time_s,
        "limits": limits,
        "gains": {"form": FORM},
        "device": device,
    })  # fmt: skip


async def verified(loop, gains, model):
    """Apply, verify and return the run with what the device holds in the end."""
    backend = make_backend(loop.driver, loop.device, "loops.bench")
    await backend.open()
    await backend.write({"kp": gains.Kp, "ti": gains.Ti if math.isfinite(gains.Ti) else 0.0, "td": gains.Td})
    run = VerificationRun()

    async def undo():
        await backend.open()
        await backend.write(OLD)

    claim = Claim(model, None, PidSettings(gains), STEP, loop.sample_time_s)
    await Verifier(loop, backend, claim, InPlace(), undo, run).conduct()
    await backend.open()
    held = await backend.read([*OLD, SET_POINT, AUTO, OUTPUT])
    await backend.close()
    return run, held


def verify(truth, kind, seed):
    """Return whether it passed, whether everything is back where it belongs, the largest PV in rooms, and why."""
    values = {name: value * WRONG[kind].get(name, 1.0) for name, value in truth.parameters().items()}
    model = type(truth)(**values)
    band = STICKING * STEP / truth.K
    effects = [{"effect": "stiction", "band": band}] if kind == "sticking" else []
    noise = NOISE * QUIETER if effects else NOISE
    loop, gains = (
        loop_of(truth, effects, noise, seed),
        held_by_device(design(model).gains, FORM, fixed_b=1.0, fixed_N=DERIVATIVE_FILTER).gains,
    )
    with asyncio.Runner(loop_factory=async_solipsism.EventLoop) as runner:
        run, held = runner.run(verified(loop, gains, model))
    kept = {"kp": gains.Kp, "ti": gains.Ti, "td": gains.Td} if run.passed else OLD
    rest = {SET_POINT: PV, AUTO: 0.0, OUTPUT: OUTPUT_AT_REST}
    back = all(math.isclose(held[name], value, rel_tol=1e-6, abs_tol=1e-6) for name, value in (kept | rest).items())
    largest = max((abs(sample.pv - PV) for sample in run.samples), default=0.0)
    return run.passed, back and run.rolled_back is not run.passed, largest / ROOM, run.verdict.code


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plants", type=int, default=50)
    parser.add_argument("--jobs", type=int, default=1)
    args = parser.parse_args()
    columns = f"{'plants':>7s} {'pass':>6s} {'back':>6s} {'as it should be':>16s} {'largest PV, rooms':>18s}"
    print(f"{'model':18s} {columns}  verdicts")
    for kind in WRONG:
        drawn = enumerate(plants(args.plants, 11))
        results = Parallel(args.jobs)(delayed(verify)(truth, kind, seed) for seed, truth in drawn)
        passed, kept = (sum(result[i] for result in results) for i in (0, 1))
        codes = [result[3] for result in results]
        told = ", ".join(f"{code} {codes.count(code)}" for code in sorted(set(codes)))
        largest = max(result[2] for result in results)
        columns = f"{len(results):7d} {passed:6d} {len(results) - passed:6d} {kept:16d} {largest:18.2f}"
        print(f"{kind:18s} {columns}  {told}", flush=True)


if __name__ == "__main__":
    main()
