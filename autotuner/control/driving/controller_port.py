"""Interface of the controller of one experiment, on this event loop or in the loop process."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner.control.records.lease_record import Before
    from autotuner.core.model.process import Integrating
    from autotuner.core.recording import Sample
    from autotuner.core.verdict import Verdict


class Conducted(Protocol):
    """An experiment, as far as a tuning uses it."""

    @property
    def warnings(self) -> Sequence[str]:
        """Warnings of the experiment."""

    def inform(self, model_error: float, expected_loss: float = 0.0, *, integrating: Integrating | None = None) -> None:
        """Take the uncertainty of a model that explains the record so far, see `Experiment.inform`."""

    def settings_so_far(self) -> dict[str, object]:
        """Return the settings for the recording, JSON-ready."""


class Conductor(Protocol):
    """Conducts one experiment on one device; its published state is only appended to or replaced as a whole."""

    @property
    def samples(self) -> list[Sample]:
        """The recording so far."""

    @property
    def experiment(self) -> Conducted | None:
        """The experiment, once the device has been found."""

    @property
    def before(self) -> Before | None:
        """State in which the loop was found."""

    @property
    def restored(self) -> bool | None:
        """Whether the loop was released; None before that is decided."""

    def abort(self, verdict: Verdict) -> None:
        """Request the end; the output is restored at once, the first verdict counts."""

    async def run(self) -> Verdict | None:
        """Conduct the experiment to its end; return the reason for a missing result, or None after convergence."""
