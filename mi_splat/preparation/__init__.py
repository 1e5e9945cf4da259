"""From photographs or a video to a set of images with cameras, by COLMAP."""
