"""From photographs or a video to a set of pictures with cameras, by COLMAP (`pip install -e '.[colmap]'`)."""
