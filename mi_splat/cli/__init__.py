"""The commands that render, describe, capture and train; `attacks.cli` is the entry
point that finds them.
"""
