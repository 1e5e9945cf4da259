"""What the audit is compared with: baselines that score splats, a trained classifier, and an adaptive attacker."""
