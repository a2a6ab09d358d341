"""Image -> latent -> (DyFN) -> latent -> points."""
