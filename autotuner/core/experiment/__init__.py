"""The relay experiment: settings, phases, stages, the relay and its adjustment, refusals."""
