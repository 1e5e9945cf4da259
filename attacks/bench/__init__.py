"""The scoreboard: one suite of attacks that is the same for all, and one row for what
was measured with it.
"""
