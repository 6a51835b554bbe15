"""What the physics leaves over: residuals to learn, the Gaussian process that learns them, and
hybrid models."""
