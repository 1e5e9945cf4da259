"""Studies: one TOML file says what is done how often, and every piece of work is a job
that is done once.
"""
