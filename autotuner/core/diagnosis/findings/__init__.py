"""Findings of a diagnosis: verdict, errors by part, advice, gains with and without the effects."""
