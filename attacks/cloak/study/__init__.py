"""A whole study of CLOAK from one file: capture, poison, train, observe, report."""
