"""From the boxes of objects to detections: solids, rays, rasters."""
