"""Is the attack sane: checks after Carlini et al., "On Evaluating Adversarial Robustness" (2019), each red or green."""
