"""A trained agent on its own: detections in, actions out."""
