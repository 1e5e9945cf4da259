"""One page of one or several results: what was done, what came of it, how sure that is,
and how to repeat it.
"""
