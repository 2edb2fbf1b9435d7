"""Rows that the thesis prints of its training data, tables 4.1 to 4.4, and the scores of its table 5.1.

Figures are strings, so that the digits printed are known. All rows have relay height 1. `A` PV, zero to peak; `Pu`,
`T`, `D`, `T1`, `T2`, `n` s; `m` s^2. The thesis prints no true parameters for them. In tables 4.1 and 4.2 they
follow from its grid: rows 0 to 4 are T 1 to 3 by 0.5 with K 1 and D 2, rows 580 to 584 are T 18 to 20 with K 9, D 8.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from autotuner_models.thesis.printed import Misprint

if TYPE_CHECKING:
    from collections.abc import Mapping


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
