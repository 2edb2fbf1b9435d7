"""Present tables of the database; `autotuner.service.archive.storage.migrations` has the earlier versions.

schema_version    version of the tables
tunings           id, loop, started_at, actor; number: grows with each archived tuning, even when the clock is set
                  back; request, told, recording_settings, versions: JSON, of the request, the last
                  `TuningRun.to_dict`, the phases of the experiment, the software versions; outcome, code, phase:
                  as in told, for lists; the first two are null while it runs; result: JSON, model and gains for
                  lists (`autotuner.service.archive.archive_record.result_of`)
recording_chunks  tuning_id, first, samples: those from number `first` on, rows of six little-endian float64
                  (`autotuner.service.archive.storage.packed`)
events            tuning_id, number, t_s, data: events besides the samples, as JSON; `number` counts the
                  samples too, which fill the gaps
gains             number, tuning_id, loop, at, action, before, after: gains of a device before and after each
                  change, the number of each signal, as JSON
audit             number, at, actor, action, status, loop, tuning_id: actor and action, with the status of the answer,
                  and the loop and the tuning concerned
"""

from __future__ import annotations

OF_A_TUNING = (("events", "tuning_id"), ("recording_chunks", "tuning_id"), ("gains", "tuning_id"), ("tunings", "id"))
"""The tables of which rows go when a tuning goes, and the column that names it. The audit stays."""
