"""What detectors report, as rows, and the rates that are counted from rows."""
