"""The tables as they are now; how an older database gets there is in `autotuner.store.migrations`."""

from __future__ import annotations

from sqlalchemy import Column, Float, Integer, LargeBinary, MetaData, String, Table, Text

metadata = MetaData()

version = Table("schema_version", metadata, Column("version", Integer, nullable=False))
tunings = Table(
    "tunings",
    metadata,
    Column("id", String(64), primary_key=True),
    Column("loop", String(200), nullable=False, index=True),
    Column("started_at", String(40), nullable=False, index=True),
    Column("actor", String(200), nullable=False),
    Column("request", Text, nullable=False),
    Column("told", Text, nullable=False),
    Column("recording_settings", Text, nullable=False),
    Column("outcome", String(20)),
    Column("code", String(60)),
    Column("phase", String(20)),
    Column("versions", Text),
)
"""`request`, `told`, `recording_settings` and `versions` are JSON: what was asked, what `Tuning.to_dict` told last, the
parts of the experiment, and what analysed it. `outcome`, `code` and `phase` are as in `told`, to be listed; the first
two are null while it runs."""
chunks = Table(
    "recording_chunks",
    metadata,
    Column("tuning_id", String(64), primary_key=True),
    Column("first", Integer, primary_key=True),
    Column("samples", LargeBinary, nullable=False),
)
"""Samples from number `first` on: rows of six little-endian float64 (see `autotuner.store.packed`)."""
events = Table(
    "events",
    metadata,
    Column("tuning_id", String(64), primary_key=True),
    Column("number", Integer, primary_key=True),
    Column("t_s", Float, nullable=False),
    Column("data", Text, nullable=False),
)
"""What happened beside the samples, as JSON; `number` counts the samples too, which fill the gaps."""
gains = Table(
    "gains",
    metadata,
    Column("number", Integer, primary_key=True, autoincrement=True),
    Column("tuning_id", String(64), nullable=False, index=True),
    Column("loop", String(200), nullable=False),
    Column("at", String(40), nullable=False),
    Column("action", String(20), nullable=False),
    Column("before", Text, nullable=False),
    Column("after", Text, nullable=False),
)
"""Gains of a device before and after each change: the number of each signal, as JSON."""
audit = Table(
    "audit",
    metadata,
    Column("number", Integer, primary_key=True, autoincrement=True),
    Column("at", String(40), nullable=False),
    Column("actor", String(200), nullable=False),
    Column("action", String(400), nullable=False),
    Column("status", Integer, nullable=False),
    Column("loop", String(200), index=True),
    Column("tuning_id", String(64)),
)
"""Who did what, with the status of the answer, and to which loop and tuning it was done where it was to one."""
OF_A_TUNING = ((events, "tuning_id"), (chunks, "tuning_id"), (gains, "tuning_id"), (tunings, "id"))
"""What goes when a tuning goes, and the column that names it. The audit stays."""
