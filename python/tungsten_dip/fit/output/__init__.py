"""From the network's output to the image and its estimated error."""
