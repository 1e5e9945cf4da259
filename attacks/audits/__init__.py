"""What an audit of splats is measured against: other ways to find hidden looks, and an attacker who knows the audit."""
