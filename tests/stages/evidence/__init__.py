"""Evidence: routes, and what the judge makes of small pieces of it."""
