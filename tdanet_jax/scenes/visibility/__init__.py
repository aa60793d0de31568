"""From the boxes of objects to detections: solids and rays."""
