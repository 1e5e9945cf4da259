"""How the two small detectors that the project ships are trained, on its own pictures."""
