"""Error against run time: every setting that trades one for the other, tried on a capture, on one page.

``knobs`` lists the settings; ``measure`` fits one of them in a process of its own, ``shared`` many that go on from the
same mask table; ``asking`` tries those of the finished file, ``baselines`` holds other methods on that table beside it.
``sweep`` puts them in order, ``judging`` says what is on the front, ``plots`` and ``page`` show it.
"""
