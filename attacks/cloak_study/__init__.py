"""A study of CLOAK in one file: capture, poison, train a clean control and a cloaked splat, look at both, report.

`plan` is the file, `places` what it describes as meshes and cameras, `stages` the work, each stage kept by its content,
`sightings` and `summary` the figures, `figures` the pictures, and `runner` does it all.
"""
