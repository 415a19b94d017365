"""The largest error that no monitor would have noticed."""
