"""What `mi-splat view` shows of attacks: results side by side, detections, triggers."""
