"""A neural network from a relay test to a first-order process.

    T, D = net(h, K, A, Pu, T_df, D_df)

two networks, trained on the thesis's grid of FOPDT processes (`thesis.regressors`, family ``network``). The thesis
names Sharma et al. for it ("used neural networks to identify parameters of stable FOPDT transfer function"). It states
neither their inputs nor their network, and prints no figures of theirs: inputs and data are those of its chapter 4.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.identification.limit_cycle import describing_function
from autotuner.core.model.process import Fopdt
from autotuner.errors import InputError
from autotuner_models.literature.trial import FOPDT, SYMMETRIC, Method

if TYPE_CHECKING:
    from autotuner.core.model.process import ProcessModel
    from autotuner_models.literature.trial import Trial


def estimate(trial: Trial) -> ProcessModel:
    """Return the process that the networks predict."""
    from autotuner_models.thesis.regressors import trained  # noqa: PLC0415 - trains, and needs scikit-learn

    cycle = trial.cycle(SYMMETRIC)
    begun = describing_function.fopdt(trial.K, cycle.h, cycle.A, cycle.Pu)
    row = np.array([[cycle.h, trial.K, cycle.A, cycle.Pu, begun.T, begun.D]])
    T, D = (float(trained("fopdt", column, "network").regressor.predict(row)[0]) for column in (0, 1))
    if not (T > 0.0 and D >= 0.0):
        raise InputError(f"comes out as {T:.3g}", field="T", remedy="Use a process within the range of the training.")
    return Fopdt(trial.K, T, D)


METHOD = Method("neural_network", "Neural network (Sharma et al.)", FOPDT, estimate)
