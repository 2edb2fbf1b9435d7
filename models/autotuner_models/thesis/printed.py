"""Figures printed in the thesis's comparison tables, with the misprints marked.

Source: B. Kumar, Machine Learning for Improved Autotune Identification Method, M.Tech. thesis, Indian Institute of
Technology Guwahati; tables 2.1 to 2.3 and 5.2 to 5.7. All relay tests have height `h` = 1.

Invariants: figures are strings, so that the digits printed are known; the thesis cuts digits off as often as it
rounds them. A `Misprint` has the correct figure and the reason. A table with one column "% Error" has it as
`percent`.

`K` PV/output; `D`, `T`, `T1`, `T2`, `n`, `Pu` s; `m` s^2; `A` PV, zero to peak; errors in percent of the truth.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

OFFLINE = "Offline"
"""The row of the thesis's own describing-function estimate."""
PROPOSED = "Proposed"
"""The row of the thesis's learned estimate."""


@dataclass(frozen=True, slots=True)
class Misprint:
    """A figure that cannot be as printed.

    Attributes
    ----------
    name : str
        Parameter, ``A``, or ``error in`` a parameter.
    right : str
        What it should read.
    why : str
        How that is known.
    """

    name: str
    right: str
    why: str


@dataclass(frozen=True, slots=True)
class Row:
    """One method of a table.

    Attributes
    ----------
    method : str
        Its name.
    printed, errors : mapping
        Its parameters, and their errors in percent where the table has them by parameter.
    misprints : tuple of Misprint
        Which of these cannot be right.
    percent : str, optional
        The one figure of a column "% Error", which the thesis does not define.
    remade_by : str
        Name of the comparator that follows the same principle; empty for none.
    """

    method: str
    printed: Mapping[str, str]
    errors: Mapping[str, str] = field(default_factory=dict)
    misprints: tuple[Misprint, ...] = ()
    percent: str | None = None
    remade_by: str = ""

    def misprint(self, name: str) -> Misprint | None:
        """Return the misprint of a figure, or None."""
        return next((misprint for misprint in self.misprints if misprint.name == name), None)


@dataclass(frozen=True, slots=True)
class ThesisTable:
    """One table.

    Attributes
    ----------
    number : str
        Its number.
    structure : str
        Structure of the process.
    truth : mapping
        Its parameters.
    rows : tuple of Row
        The methods compared.
    A, Pu : str, optional
        Amplitude and period of the limit cycle, where the text states them.
    misprint : Misprint, optional
        What is wrong with the amplitude.
    """

    number: str
    structure: str
    truth: Mapping[str, float]
    rows: tuple[Row, ...]
    A: str | None = None
    Pu: str | None = None
    misprint: Misprint | None = None

    def row(self, method: str) -> Row:
        """Return the row of a method."""
        return next(row for row in self.rows if row.method == method)


TABLES: tuple[ThesisTable, ...] = (
    ThesisTable(
        "2.1",
        "fopdt",
        {"K": 1.0, "T": 10.0, "D": 2.0},
        (
            Row(OFFLINE, {"T": "8.121", "D": "1.99"}, {"T": "18.79", "D": "0.5"}),
            Row(
                "Li et al.",
                {"T": "8.02", "D": "1.99"},
                {"T": "19.8", "D": "0"},
                (Misprint("error in D", "0.5", "1.99 against 2"),),
                remade_by="two_relays",
            ),
            Row(
                "Kumar et al. (offline)",
                {"T": "8.179", "D": "2.021"},
                {"T": "18.27", "D": "1.08"},
                (
                    Misprint("error in T", "18.21", "8.179 against 10"),
                    Misprint("error in D", "1.05", "2.021 against 2"),
                ),
                remade_by="describing_function",
            ),
            Row(
                "Kumar et al. (online)",
                {"T": "9.79", "D": "1.995"},
                {"T": "2.09", "D": "0.48"},
                (
                    Misprint("error in T", "2.10", "9.79 against 10"),
                    Misprint("error in D", "0.25", "1.995 against 2"),
                ),
                remade_by="online",
            ),
            Row(
                "Bajrangbali et al.",
                {"K": "0.9994", "T": "9.9957", "D": "2"},
                {"T": "0.043", "D": "0"},
                remade_by="state_space",
            ),
        ),
    ),
    ThesisTable(
        "2.2",
        "sopdt_overdamped",
        {"K": 1.0, "T1": 10.0, "T2": 1.0, "D": 2.0},
        (
            Row(OFFLINE, {"T1": "9.87", "T2": "0.9907"}, {"T1": "1.3", "T2": "0.93"}),
            Row(
                "Li et al.",
                {"T1": "7.416", "T2": "1.15"},
                {"T1": "19.8", "T2": "0"},
                (
                    Misprint("error in T1", "25.8", "7.416 against 10; 19.8 and 0 are those of table 2.1"),
                    Misprint("error in T2", "15", "1.15 against 1; 19.8 and 0 are those of table 2.1"),
                ),
                remade_by="two_relays",
            ),
            Row(
                "Shen et al.",
                {"K": "0.998", "T1": "9.14", "T2": "1.044"},
                {"T1": "8.6", "T2": "4.4"},
                remade_by="dual_input",
            ),
            Row(
                "Bajrangbali et al.",
                {"K": "0.9923", "T1": "9.8997", "T2": "1.0105"},
                {"T1": "1.003", "T2": "1.05"},
                remade_by="state_space",
            ),
        ),
    ),
    ThesisTable(
        "2.3",
        "sopdt_underdamped",
        {"K": 1.0, "m": 9.0, "n": 2.4, "D": 1.0},
        (
            Row(OFFLINE, {"m": "9.09", "n": "2.285"}, percent="1.28"),
            Row("Chen et al. (first order)", {"T": "3.96", "D": "3.35"}, percent="29.48"),
            Row("Bajrangbali et al.", {"m": "9.099", "n": "2.289"}, percent="1.24", remade_by="state_space"),
        ),
    ),
    ThesisTable(
        "5.2",
        "fopdt",
        {"K": 1.65, "T": 20.0, "D": 10.0},
        (
            Row(OFFLINE, {"T": "16.301", "D": "9.981"}, {"T": "18.49", "D": "0.19"}),
            Row("Chang et al.", {"T": "19.97", "D": "10"}, {"T": "0.15", "D": "0"}, remade_by="sampled_data"),
            Row(
                PROPOSED,
                {"T": "20", "D": "9.92"},
                {"T": "20", "D": "0.8"},
                (Misprint("error in T", "0", "20 against 20"),),
            ),
        ),
        A="0.6491",
        Pu="33.272",
    ),
    ThesisTable(
        "5.3",
        "fopdt",
        {"K": 8.1, "T": 9.4, "D": 5.2},
        (
            Row(
                OFFLINE,
                {"T": "7.67", "D": "5.187"},
                {"T": "23.3", "D": "0.25"},
                (Misprint("error in T", "18.4", "7.67 against 9.4"),),
            ),
            Row(
                PROPOSED,
                {"T": "9.5", "D": "5.247"},
                {"T": "1.05", "D": "0.9"},
                (Misprint("error in T", "1.06", "9.5 against 9.4"),),
            ),
        ),
        A="3.441",
        Pu="17.057",
    ),
    ThesisTable(
        "5.4",
        "sopdt_overdamped",
        {"K": 1.0, "T1": 10.0, "T2": 2.0, "D": 4.0},
        (
            Row(
                OFFLINE,
                {"T1": "10.1198", "T2": "1.8578", "D": "2"},
                misprints=(
                    Misprint("D", "4", "the process has 4 s, and only 4 s gives these lags"),
                    Misprint("T1", "10.1189", "digits swapped: the text has 10.1189"),
                ),
                percent="1.56",
            ),
            Row(
                "Fedele (first order)",
                {"K": "1.0015", "T": "10.4495", "D": "5.647"},
                percent="0.0143",
                remade_by="step_integral",
            ),
            Row(PROPOSED, {"T1": "10", "T2": "2", "D": "2"}, misprints=(Misprint("D", "4", "as above"),), percent="0"),
        ),
        A="0.3129",
        Pu="19.117",
    ),
    ThesisTable(
        "5.5",
        "sopdt_overdamped",
        {"K": 1.5, "T1": 7.5, "T2": 4.2, "D": 5.0},
        (
            Row(
                OFFLINE,
                {"T1": "7.8231", "T2": "3.7532"},
                {"T1": "4.3", "T2": "9.92"},
                (Misprint("error in T2", "10.6", "3.7532 against 4.2"),),
            ),
            Row(PROPOSED, {"T1": "7.5", "T2": "4"}, {"T1": "0", "T2": "4.76"}),
        ),
        A="0.6194",
        Pu="24.674",
    ),
    ThesisTable(
        "5.6",
        "sopdt_underdamped",
        {"K": 1.0, "m": 1.0, "n": 0.4, "D": 3.0},
        (
            Row(
                OFFLINE,
                {"m": "1.32", "n": "0.68"},
                {"m": "32.6", "n": "70"},
                (
                    Misprint("m", "0.9869", "its formula on the stated A and Pu gives the row of Lavanya et al."),
                    Misprint("n", "0.4252", "its formula on the stated A and Pu gives the row of Lavanya et al."),
                    Misprint("error in m", "1.31", "0.9869 against 1"),
                    Misprint("error in n", "6.3", "0.4252 against 0.4"),
                ),
            ),
            Row(
                "Lavanya et al.",
                {"m": "0.9869", "n": "0.4252"},
                {"m": "2.45", "n": "1.1"},
                (
                    Misprint("error in m", "1.31", "0.9869 against 1"),
                    Misprint("error in n", "6.3", "0.4252 against 0.4"),
                ),
            ),
            Row(PROPOSED, {"m": "1", "n": "0.391"}, {"m": "0", "n": "2.25"}),
        ),
        A="2.536",
        Pu="7.861",
    ),
    ThesisTable(
        "5.7",
        "sopdt_underdamped",
        {"K": 3.5, "m": 9.4, "n": 3.7, "D": 7.0},
        (
            Row(
                OFFLINE,
                {"m": "8.652", "n": "3.801"},
                {"m": "7.9", "n": "2.73"},
                (
                    Misprint("m", "8.625", "digits swapped: the text has 8.625, which goes with n 3.801"),
                    Misprint("error in m", "8.2", "8.625 against 9.4"),
                ),
            ),
            Row(PROPOSED, {"m": "9", "n": "3.61"}, {"m": "4.25", "n": "2.43"}),
        ),
        A="4.956",
        Pu="23.076",
        misprint=Misprint("A", "4.066", "4.956 gives m 9.499 and n 3.119; the printed n needs 4.066"),
    ),
)


BIAS_RATIOS: tuple[float, ...] = (0.01, 0.1, 0.5, 1.0, 2.0, 5.0, 10.0, 50.0)
"""Ratios D/T of the table of the describing function's bias."""

BIAS: dict[str, tuple[str, ...]] = {
    "Ku": ("-18.9", "-18.2", "-15.0", "-10.9", "-3.1", "13.2", "22.4", "27.1"),
    "Pu": ("-0.1", "-0.8", "-2.7", "-3.8", "-4.4", "-3.9", "-2.6", "-0.6"),
    "T": ("-18.9", "-18.9", "-18.5", "-17.1", "-9.8", "45", "168", "1170"),
    "D": ("0.0", "0.0", "-0.2", "-0.9", "-3.3", "-10.7", "-15.8", "-20.2"),
}
"""Known errors in percent of the describing function on the peak of an exact FOPDT cycle, static gain given."""
