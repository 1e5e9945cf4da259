"""Detectors that others trained on COCO, from the packages in which they are published."""
