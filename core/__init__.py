"""Pure numerics of dcam: images and numbers in, numbers with covariance out."""
