"""Error against run time: every setting that trades one for the other, tried on a capture, on one page.

``knobs`` lists the settings, ``measure`` fits one of them in a process of its own, ``asking`` tries those of the
finished file, ``baselines`` holds other methods on the same mask table beside it; ``sweep`` puts them in order,
``plots`` and ``page`` show them.
"""
