"""Captures from depth cameras: importers, the USD stage they become, simulation, live filtering, reconstruction."""
