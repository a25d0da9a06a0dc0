"""A recorded video from nothing: cameras, depth, hands, scale, background, moved objects."""
