"""Transfer of DAGGER: attacks on some detectors, judged by others."""
