"""What is done with the noisy image before anything is computed from it."""
