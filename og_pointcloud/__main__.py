"""``python -m og_pointcloud``: the command line, where the program ``og-pointcloud`` is not on the path."""

from og_pointcloud.cli import main

raise SystemExit(main())
