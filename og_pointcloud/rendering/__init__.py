"""Points -> what each view shows of them: Gaussians for a plain cloud, blending weights."""
