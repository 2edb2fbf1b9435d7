"""Verification: a step of the set point under the new gains, judged against its prediction."""
