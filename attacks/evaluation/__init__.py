"""What both attacks are judged by: visibility, detections on 8-bit pictures, rates with intervals, drawings."""
