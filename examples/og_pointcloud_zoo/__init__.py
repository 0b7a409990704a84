"""Many small scenes of many kinds, half of them for choosing and half for judging: `examples/zoo.py`."""
