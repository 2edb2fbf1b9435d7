"""What a diagnosis found: verdict, errors by part, advice, gains with and without the effects."""
