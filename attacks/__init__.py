"""Everything adversarial: detectors, objectives, budgets, attacks, evaluation. Imports mi_splat, never the reverse."""
