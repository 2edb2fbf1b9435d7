"""Figures printed in the tables of the thesis, comparisons and training data, with the misprints marked.

Source: B. Kumar, Machine Learning for Improved Autotune Identification Method, M.Tech. thesis, Indian Institute of
Technology Guwahati; tables 2.1 to 2.3, 4.1 to 4.4 and 5.2 to 5.7. All relay tests have height `h` = 1.

Invariants: figures are strings, so that the digits printed are known; the thesis cuts digits off as often as it
rounds them. A `Misprint` has the correct figure and the reason. A table with one column "% Error" has it as
`percent`.

`K` PV/output; `D`, `T`, `T1`, `T2`, `n`, `Pu` s; `m` s^2; `A` PV, zero to peak; errors in percent of the truth.

Tables 4.1 to 4.4 print no true parameters. In tables 4.1 and 4.2 they follow from the thesis's grid: rows 0 to 4 are T
1 to 3 by 0.5 with K 1 and D 2, rows 580 to 584 are T 18 to 20 with K 9, D 8.
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


@dataclass(frozen=True, slots=True)
class DataTable:
    """One table of training data.

    Attributes
    ----------
    number, structure : str
        Its number, and the structure of its processes.
    columns : tuple of str
        Names of the printed figures of a row, after its number and the relay height.
    rows : mapping of int to tuple of str
        Printed figures by row number.
    misprints : mapping of (int, str) to Misprint
        By row and column.
    """

    number: str
    structure: str
    columns: tuple[str, ...]
    rows: Mapping[int, tuple[str, ...]]
    misprints: Mapping[tuple[int, str], Misprint]


def _first_order_rows(text: str) -> dict[int, tuple[str, ...]]:
    rows = [line.split() for line in text.strip().splitlines()]
    return {int(row[0]): tuple(row[1:]) for row in rows}


TABLE_4_1 = DataTable(
    "4.1",
    "fopdt",
    ("K", "A", "Pu", "T", "D"),
    _first_order_rows("""
        0 1 0.8540 5.248 0.9237 1.9260
        1 1 0.7362 5.656 0.1.2703 1.9680
        2 1 0.6316 5.960 1.6604 1.9823
        3 1 0.5484 6.194 2.0666 1.9872
        4 1 0.4866 6.379 2.4550 1.9928
        580 9 3.227 27.038 14.663 7.9877
        581 9 3.16 27.133 15.053 7.9895
        582 9 3.089 27.225 15.479 7.9887
        583 9 3.027 27.313 15.873 7.9901
        584 9 2.966 27.396 16.274 7.9909
    """),
    {(1, "T"): Misprint("T", "1.2703", "two decimal points")},
)
TABLE_4_2 = DataTable(
    "4.2",
    "fopdt",
    ("K", "A", "Pu", "T", "D"),
    _first_order_rows("""
        0 1 0.8540 5.248 0.9042 1.9350
        1 1 0.7298 5.656 1.2870 1.9534
        2 1 0.6310 5.960 1.6625 1.9818
        3 1 0.5460 6.194 2.0769 1.9854
        4 1 0.4788 6.379 2.5018 1.9961
        580 9 3.1930 27.038 14.833 7.9744
        581 9 3.1230 27.133 15.246 7.9750
        582 9 3.0620 27.225 15.627 7.9781
        583 9 3.0050 27.313 15.997 7.9815
        584 9 2.9300 27.396 16.488 7.9768
    """),
    {},
)
TABLE_4_3 = DataTable(
    "4.3",
    "sopdt_overdamped",
    ("K", "D", "A", "Pu", "T1", "T2"),
    _first_order_rows("""
        0 1 2 0.5490 8.209 2.161 0.803
        1 1 2 0.4484 8.877 3.009 0.955
        2 1 2 0.3723 9.319 3.978 0.9701
        3 1 2 0.3148 9.605 5.016 10.9547
        4 1 2 0.2729 9.90 6.039 0.9805
        1430 10 4 2.6120 25.030 11.306 5.076
        1431 3 7 1.7030 26.350 7.542 1.818
        1432 6 6 3.619 23.668 5.481 2.4683
        1433 11 5 5.3710 20.851 6.724 1.9113
        1434 8 4 1.987 26.32 11.458 6.070
    """),
    {(3, "T2"): Misprint("T2", "0.9547", "a 1 too many: eq. 3.14 on the row's A and Pu gives 0.9547")},
)
TABLE_4_4 = DataTable(
    "4.4",
    "sopdt_underdamped",
    ("K", "D", "A", "Pu", "m", "n"),
    _first_order_rows("""
        0 8 4 9.385 8.209 8.8909 2.9958
        1 3 2 1.383 8.877 7.1633 4.4513
        2 8 2 3.448 9.319 6.2828 4.6488
        3 6 5 7.421 9.605 9.4989 3.2182
        4 5 8 16.840 9.90 10.307 1.1136
        727 1 3 2.152 25.030 0.9786 0.5508
        728 1 3 2.746 26.350 1.4860 0.5508
        729 1 3 2.800 23.668 0.9956 0.3649
        730 1 3 2.536 20.851 0.9869 0.4252
        731 1 1 0.759 26.32 7.627 1.5900
    """),
    {},
)
