"""Campaigns against truths that what is judged cannot know."""
