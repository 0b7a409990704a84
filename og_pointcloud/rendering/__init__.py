"""Points -> what each view shows of them: Gaussians of a plain cloud, blending weights."""
