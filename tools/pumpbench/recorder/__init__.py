"""The recorder: a passive node that turns what it hears on the bus into a run folder.

It listens to the device's bus, and to the plant's as well when a gateway lies between, from before the roll call until
the plant has closed the run. It never sends and nobody waits for it. What it hears goes to the disk at once; only at
the end does it analyse and import what draws. Who wants to watch gets another process.
"""
