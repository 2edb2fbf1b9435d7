"""Linear models by other people's packages, for `recordings.py`; those not installed are left out.

    N4SID   nfoursid, and SIPPY (package sippy_unipi): subspace, state space of a given order
    ARX     SIPPY: least squares about the mean; SysIdentPy: least squares with a constant term

Neither knows a dead time of its own but by whole samples: it is tried at every number of them. Every model is
simulated (not predicted: no measured PV goes in) over the whole record, its initial state and offset fitted to the
first half, as ours is.
"""

import contextlib
import importlib
import importlib.util
import io
import itertools
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

LONGEST_DELAY = 20
BLOCK_ROWS = 15


@dataclass(frozen=True)
class Tried:
    """One fit: what it is called, its order and delays, its simulation, and what its package would choose it by.

    It `heats` where it settles and its PV rises with every input, as that of a heater does.
    """

    name: str
    order: int
    delays: tuple[int, ...]
    simulation: np.ndarray
    loss: float
    heats: bool


def tried(family, inputs, y, half, order):
    """Yield the fits of a family at every delay, every input with its own.

    One sample of delay at least: with none, a record under a P controller is explained by that controller's inverse.
    """
    if importlib.util.find_spec(family.package) is None:
        return
    u, v = centred(inputs, half), y - y[:half].mean()
    for delays in itertools.product(range(1, LONGEST_DELAY + 2), repeat=len(inputs)):
        with contextlib.suppress(Exception), warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            simulate, loss, heats = family.fit(u, v, half, order, delays)
            simulation = completed(simulate, u, y, half, order)
            if np.all(np.isfinite(simulation)) and np.abs(simulation).max() < 1e9:
                name = f"{family.symbol}({order}), delay {'+'.join(str(d) for d in delays)}"
                yield Tried(name, order, delays, simulation, loss, heats)


def completed(simulate, u, y, half, states):
    """Return a simulated PV, initial state and offset fitted to the first half; `simulate(u, x0)` is linear in both."""
    driven = simulate(u, np.zeros(states))
    free = [simulate(np.zeros_like(u), column) for column in np.eye(states)]
    phi = np.column_stack([*free, np.ones(y.size)])
    if not np.all(np.isfinite(phi)) or not np.all(np.isfinite(driven)):
        raise ValueError("the model runs away")
    found, *_ = np.linalg.lstsq(phi[:half], (y - driven)[:half], rcond=None)
    return driven + phi @ found


def centred(inputs, half):
    """Return the inputs about their means over the first half."""
    rows = np.array(inputs)
    return rows - rows[:, :half].mean(axis=1, keepdims=True)


def later(inputs, delays):
    """Return the inputs, each so many samples later."""
    return np.array([np.concatenate((np.full(d, u[0]), u))[: u.size] for u, d in zip(inputs, delays, strict=True)])


def nfoursid(u, y, half, order, delays):
    """N4SID of nfoursid; left to itself it has no delay."""
    pandas, package = importlib.import_module("pandas"), importlib.import_module("nfoursid.nfoursid")
    late, names = centred(later(u, delays), half), [f"u{k}" for k in range(len(u))]
    frame = pandas.DataFrame({**dict(zip(names, late[:, :half], strict=True)), "y": y[:half]})
    fit = package.NFourSID(frame, output_columns=["y"], input_columns=names, num_block_rows=BLOCK_ROWS)
    fit.subspace_identification()
    model, _ = fit.system_identification(rank=order)
    a, b, c, d = (np.array(part) for part in (model.a, model.b, model.c, model.d))
    return state_space(a, b, c, d, delays, half), float(sum(delays)), state_space_heats(a, b, c, d)


def sippy_n4sid(u, y, half, order, delays):
    """N4SID of SIPPY; left to itself it has no delay."""
    identified = importlib.import_module("sippy_unipi").system_identification
    model = identified(y[:half], centred(later(u, delays), half)[:, :half], "N4SID", SS_fixed_order=order)
    a, b, c, d = (np.array(part) for part in (model.A, model.B, model.C, model.D))
    return state_space(a, b, c, d, delays, half), float(sum(delays)), state_space_heats(a, b, c, d)


def state_space(a, b, c, d, delays, half):
    """Return the simulation of `x' = a x + b u, y = c x + d u`, the inputs about their means over the first half."""

    def simulate(u, x):
        late = centred(later(u, delays), half)
        out, driven, fed = np.empty(late.shape[1]), b @ late, d @ late
        for k in range(out.size):
            out[k] = (c @ x).item() + fed[0, k]
            x = a @ x + driven[:, k]
        return out

    return simulate


def state_space_heats(a, b, c, d):
    """Return whether it settles, and its static gains `c (1 - a)^-1 b + d` are positive."""
    gains = c @ np.linalg.solve(np.eye(len(a)) - a, b) + d
    return bool(np.all(np.abs(np.linalg.eigvals(a)) < 1.0) and np.all(gains > 0.0))


def sippy_arx(u, y, half, order, delays):
    """ARX of SIPPY; its criteria choose a delay by the one-step prediction."""
    identified = importlib.import_module("sippy_unipi").system_identification
    orders = [[order], [[order] * len(u)], [[delay - 1 for delay in delays]]]
    model = identified(y[:half], u[:, :half].copy(), "ARX", ARX_orders=orders)
    a = np.array(model.DENOMINATOR[0][0])[: order + 1]
    # A numerator begins one sample late: its first place is `u(k - 1)`.
    b = [np.array(part)[delay - 1 : delay - 1 + order] for part, delay in zip(model.NUMERATOR[0], delays, strict=True)]
    return equation(a, b, delays), float(model.Vn), equation_heats(a, b)


def sysidentpy_arx(u, y, half, order, delays):
    """ARX with a constant, of SysIdentPy; its criteria choose terms by the one-step prediction."""
    load = importlib.import_module
    least_squares = load("sysidentpy.parameter_estimation").LeastSquares()
    terms = load("sysidentpy.basis_function").Polynomial(degree=1)
    lags = [list(range(delay, delay + order)) for delay in delays]
    model = load("sysidentpy.model_structure_selection").FROLS(
        ylag=order,
        xlag=lags[0] if len(lags) == 1 else lags,
        order_selection=False,
        n_terms=order * (1 + len(lags)) + 1,
        estimator=least_squares,
        basis_function=terms,
    )
    model.fit(X=u[:, :half].T, y=y[:half, None])
    # A term's code is 1000 times its variable (0 the constant, 1 the PV, then the inputs) plus its lag.
    found = dict(zip(model.final_model.ravel().tolist(), model.theta.ravel().tolist(), strict=True))
    a = np.array([1.0, *(-found[1000 + lag] for lag in range(1, order + 1))])
    b = [np.array([found[1000 * (2 + k) + lag] for lag in late]) for k, late in enumerate(lags)]
    fed = sum(late_by(part, one, delay) for part, one, delay in zip(b, u, delays, strict=True))
    error = (lfilter(a, 1.0, y) - fed - found.get(0, 0.0))[order + max(delays) : half]
    return equation(a, b, delays), float(np.mean(error**2)), equation_heats(a, b)


def late_by(part, one, delay):
    """Return an input through a numerator that begins so many samples late."""
    return lfilter(part, 1.0, later(one[None], [delay])[0])


def equation(a, b, delays):
    """Return the simulation of `a y(k) = b u(k - delay)`, from an initial state of the filter."""

    def simulate(u, x):
        late = later(u, delays)
        first = lfilter(np.append(b[0], 0.0), a, late[0], zi=x)[0]
        return first + sum(lfilter(part, a, one) for part, one in zip(b[1:], late[1:], strict=True))

    return simulate


def equation_heats(a, b):
    """Return whether it settles, and its static gains `b(1)/a(1)` are positive."""
    settles = np.all(np.abs(np.roots(a)) < 1.0)
    return bool(settles and all(part.sum() / a.sum() > 0.0 for part in b))


@dataclass(frozen=True)
class Family:
    """A method of a package: title, package, what a fit of it is called, and how one is made."""

    title: str
    package: str
    symbol: str
    fit: Callable


FAMILIES = (
    Family("N4SID, nfoursid", "nfoursid", "n4sid", nfoursid),
    Family("N4SID, SIPPY", "sippy_unipi", "n4sid", sippy_n4sid),
    Family("ARX, SIPPY", "sippy_unipi", "ARX", sippy_arx),
    Family("ARX, SysIdentPy", "sysidentpy", "ARX", sysidentpy_arx),
)
