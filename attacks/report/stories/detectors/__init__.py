"""What the commands leave behind that look at pictures with detectors, without any attack."""
