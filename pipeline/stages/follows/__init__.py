"""Whether an odometer is made of the positions that it should check, whatever it was declared to be (DOMAIN 5.0).

In: the cleaned stream of one odometer, the positions of one solution, configuration. Out: one `Follows`.
Touches no file. May refute a declaration, never replace it: nothing that this finds makes a witness.
"""

from pipeline.stages.follows.follows import NOT_TESTED, Follows, follows_positions

__all__ = ["NOT_TESTED", "Follows", "follows_positions"]
