"""From boxes to what is seen: solids, rays, rasters."""
