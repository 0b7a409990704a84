"""Points -> what each view shows of them: which views are needed, Gaussians of a plain cloud, blending weights."""
