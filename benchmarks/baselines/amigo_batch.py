"""The test batch of PID tuning: the processes on which AMIGO was made, with their exact frequency response.

Astrom and Hagglund, J. Process Control 14, 2004, and Advanced PID Control, 2006, section 7.2. The source counts 134;
the parameter values it prints make 133, and those are here.

Independent of the package: nothing is imported from it.
"""

from dataclasses import dataclass

import numpy as np

P1 = (0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1, 1.3, 1.5, 2, 4, 6, 8, 10, 20, 50, 100, 200, 500, 1000)
P2 = (0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1, 1.3, 1.5, 2, 4, 6, 8, 10, 20, 50, 100, 200, 500)
P3 = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 2, 5, 10)
P4 = (3, 4, 5, 6, 7, 8)
P5 = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
P67_DEAD_TIMES = (0.01, 0.02, 0.05, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0)
P7 = (1, 2, 5, 10)
P8 = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1)
P9 = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)


@dataclass(frozen=True)
class Process:
    """`gain * product(numerator) / product(denominator) * exp(-D s)`; factors as ascending coefficients."""

    name: str
    family: str
    gain: float
    numerator: tuple[tuple[float, ...], ...]
    denominator: tuple[tuple[float, ...], ...]
    D: float

    @property
    def integrators(self):
        return sum(factor[0] == 0.0 for factor in self.denominator)

    def undelayed(self, s):
        """Return the response without dead time at complex `s`."""
        value = self.gain * np.ones_like(s)
        for factor in self.numerator:
            value = value * np.polyval(factor[::-1], s)
        for factor in self.denominator:
            value = value / np.polyval(factor[::-1], s)
        return value

    def __call__(self, s):
        return self.undelayed(s) * np.exp(-self.D * s)


def lag(T):
    return (1.0, float(T))


def batch():
    """Return all processes of the batch."""
    return [
        *(Process(f"P1 T={T:g}", "P1", 1.0, (), (lag(T),), 1.0) for T in P1),
        *(Process(f"P2 T={T:g}", "P2", 1.0, (), (lag(T), lag(T)), 1.0) for T in P2),
        *(Process(f"P3 T={T:g}", "P3", 1.0, (), (lag(1), lag(T), lag(T)), 0.0) for T in P3),
        *(Process(f"P4 n={n}", "P4", 1.0, (), (lag(1),) * n, 0.0) for n in P4),
        *(Process(f"P5 a={a:g}", "P5", 1.0, (), tuple(lag(a**k) for k in range(4)), 0.0) for a in P5),
        *(Process(f"P6 L={L:g}", "P6", 1.0, (), ((0.0, 1.0), lag(1 - L)), L) for L in P67_DEAD_TIMES),
        *(
            Process(f"P7 T={T:g} L={L:g}", "P7", float(T), (), (lag(T), lag(1 - L)), L)
            for T in P7
            for L in P67_DEAD_TIMES
        ),
        *(Process(f"P8 a={a:g}", "P8", 1.0, ((1.0, -a),), (lag(1),) * 3, 0.0) for a in P8),
        *(Process(f"P9 T={T:g}", "P9", 1.0, (), (lag(1), (1.0, 1.4 * T, T * T)), 0.0) for T in P9),
    ]


def ultimate(process):
    """Return `Ku`, `Pu` from the phase on a fine grid, refined by bisection."""
    w = np.geomspace(1e-4, 1e6, 200_001)
    phase = np.unwrap(np.angle(process(1j * w)))
    phase += np.round((-np.pi / 2 * process.integrators - phase[0]) / (2 * np.pi)) * 2 * np.pi
    i = int(np.argmax(phase < -np.pi))
    low, high = w[i - 1], w[i]
    for _ in range(60):
        middle = (low + high) / 2
        # Just above the crossing the response lies in the second quadrant, just below in the third.
        low, high = (middle, high) if process(1j * np.array([middle]))[0].imag < 0.0 else (low, middle)
    return float(1.0 / abs(process(1j * np.array([high]))[0])), 2 * np.pi / high


if __name__ == "__main__":
    for process in batch():
        print(f"{process.name:20s} Ku {ultimate(process)[0]:12.5g}  Pu {ultimate(process)[1]:10.5g}")
    print(len(batch()), "processes")
