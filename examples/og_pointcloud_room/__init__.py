"""A procedural furnished room, ray-cast into a capture folder with exact ground truth: the library's own demo."""
