"""Numbered requirements, checked against any firmware over any bus: `pumpbench conformance`."""
