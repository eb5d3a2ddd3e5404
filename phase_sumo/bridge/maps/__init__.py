"""Networks of SUMO, OpenStreetMap and OpenDRIVE to lane networks, road maps and map bundles."""
