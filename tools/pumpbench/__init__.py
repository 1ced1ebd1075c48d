"""pumpbench: a hardware-in-the-loop bench for insulin + pramlintide pump firmware."""

__version__ = "0.1.0"
