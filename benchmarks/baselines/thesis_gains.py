"""Gains from the models that the thesis's examples arrive at, applied to the true processes.

    python benchmarks/baselines/thesis_gains.py

For examples 1 to 6 (tables 5.2 to 5.7) the robust design (`balanced`, Ms at most 1.4) is made for the model of the
thesis's describing function ("Offline"), for that of its learned estimate ("Proposed"), and for ours from a relay
experiment with noise 20 dB under the oscillation. All are judged on the true process: Ms, Mt, error after a load step
over that of the design for the truth. Misprints of the tables are read as they should be.
"""

import warnings

from autotuner.application.analysis.procedure import analyse
from autotuner.core.design import design
from autotuner.core.model.process import model_from_dict
from autotuner_models.thesis.printed import OFFLINE, PROPOSED, TABLES
from benchmarks.accuracy.cases.relay_record import oscillation_rms, relay_record
from benchmarks.baselines.amigo_batch import Process, ultimate
from benchmarks.baselines.loop_judge import iae, sensitivities

EXAMPLES = ("5.2", "5.3", "5.4", "5.5", "5.6", "5.7")
DECIBELS = 20.0


def true_process(table):
    truth = table.truth
    if "m" in truth:
        factors = ((1.0, truth["n"], truth["m"]),)
    else:
        factors = tuple((1.0, truth[name]) for name in ("T", "T1", "T2") if name in truth)
    return Process(f"table {table.number}", "", truth["K"], (), factors, truth["D"])


def printed_model(table, method):
    """Return the model that a row prints, misprints read right, missing parameters from the truth."""
    row = table.row(method)
    printed = {
        name: float(row.misprint(name).right if row.misprint(name) else value)
        for name, value in row.printed.items()
        if name in table.truth
    }
    return model_from_dict({**table.truth, **printed}, table.structure)


def our_model(process):
    Ku, Pu = ultimate(process)
    clean, _ = relay_record(process, Ku, Pu, 0.0, 0)
    record, _ = relay_record(process, Ku, Pu, oscillation_rms(clean) * 10.0 ** (-DECIBELS / 20.0), 1)
    return analyse(record).identification.model


def main():
    warnings.simplefilter("ignore")
    head = f"{'table':6s} {'model from':12s} {'Kp':>8s} {'Ti':>8s} {'Td':>8s} {'Ms':>7s} {'Mt':>7s}"
    print(f"{head} {'error / that of truth':>22s}")
    for table in (table for table in TABLES if table.number in EXAMPLES):
        process = true_process(table)
        Pu = ultimate(process)[1]
        models = {
            "truth": model_from_dict(dict(table.truth), table.structure),
            OFFLINE: printed_model(table, OFFLINE),
            PROPOSED: printed_model(table, PROPOSED),
            "ours, 20 dB": our_model(process),
        }
        best = None
        for name, model in models.items():
            gains = design(model).gains
            numbers = (gains.Kp, gains.Ti, gains.Td, gains.Tf)
            Ms, Mt, stable = sensitivities(process, numbers, Pu)
            error = iae(process, numbers, Pu)
            best = best or error
            shown = f"{Ms:7.3f} {Mt:7.3f} {error / best:22.3f}" if stable else "unstable"
            print(f"{table.number:6s} {name:12s} {gains.Kp:8.4f} {gains.Ti:8.3f} {gains.Td:8.3f} {shown}", flush=True)


if __name__ == "__main__":
    main()
