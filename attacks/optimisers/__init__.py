"""The attack zoo: how a search moves from one point to the next, each way under a name.

A way is a function from a point and what is known of it to the next point (`attacks.search.Optimiser`). The loop, the
ball, the judge and the trace are the same for all. `attacks.optimisers.registry` has the names.
"""
