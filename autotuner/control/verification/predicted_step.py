"""What a verification is judged by: the step that is to be made, and the band of what it should do."""

from __future__ import annotations

from typing import TYPE_CHECKING

from autotuner.core.design.simulation.verification import Bounds, Rest, planned_step, predicted_band
from autotuner.core.verdict import Verdict

if TYPE_CHECKING:
    from autotuner.configuration import LoopTable
    from autotuner.control.compute_port import ComputePool
    from autotuner.control.verification.verification_run import Claim
    from autotuner.core.design import Scenario
    from autotuner.core.design.simulation.verification import Band

REST_SAMPLES = 60
"""Samples of the loop at rest before the step."""


async def foretold(
    claim: Claim, rest: Rest, loop: LoopTable, arithmetic: ComputePool
) -> tuple[Scenario, Band] | Verdict:
    """Return the step of the set point with the predicted band, or why no step can be made."""
    limits = loop.experiment_settings().limits
    scenario = await arithmetic.run(
        planned_step,
        claim.model,
        claim.settings,
        rest,
        Bounds(limits.output, limits.pv),
        sample_time_s=loop.sample_time_s,
        scan_s=claim.scan_s,
        wanted=claim.step,
    )
    if isinstance(scenario, Verdict):
        return scenario
    band = await arithmetic.run(
        predicted_band,
        claim.model,
        claim.settings,
        scenario,
        noise_sigma=rest.noise_sigma,
        covariance=claim.covariance,
        timing_s=claim.scan_s,
        sample_time_s=loop.sample_time_s,
        effects=claim.effects,
        rest_output=rest.output,
        rest_samples=REST_SAMPLES,
    )
    return scenario, band
