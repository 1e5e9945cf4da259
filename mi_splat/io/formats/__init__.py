"""The splat formats besides the PLY, one module each, and the table of what each of
them keeps.
"""
