"""What the paper leaves to a person: which ball, which points move, how many passes.

One principle: every point takes the ball in which the network expects the least error, and moves only where that is
better than staying (docs/adr/0018-expected-error.md).
"""
