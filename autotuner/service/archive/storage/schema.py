"""The tables as they are now; how a database gets there is in `autotuner.service.archive.storage.migrations`.

schema_version    version of the tables
tunings           id, loop, started_at, actor; number: grows with each one that is kept, which the time, whose clock may
                  be set back, does not; request, told, recording_settings, versions: JSON, of what was asked, what
                  `TuningRun.to_dict` told last, the parts of the experiment, what analysed it; outcome, code, phase:
                  as in told, to be listed; the first two are null while it runs; result: JSON, what a list shows
                  of model and gains (`autotuner.service.archive.archive_record.result_of`)
recording_chunks  tuning_id, first, samples: those from number `first` on, rows of six little-endian float64
                  (`autotuner.service.archive.storage.packed`)
events            tuning_id, number, t_s, data: what happened beside the samples, as JSON; `number` counts the
                  samples too, which fill the gaps
gains             number, tuning_id, loop, at, action, before, after: gains of a device before and after each
                  change, the number of each signal, as JSON
audit             number, at, actor, action, status, loop, tuning_id: who did what, with the status of the answer,
                  and to which loop and tuning it was done where it was to one
"""

from __future__ import annotations

OF_A_TUNING = (("events", "tuning_id"), ("recording_chunks", "tuning_id"), ("gains", "tuning_id"), ("tunings", "id"))
"""The tables of which rows go when a tuning goes, and the column that names it. The audit stays."""
