"""Maps that grow with every frame, and that know what came, went and moved."""
