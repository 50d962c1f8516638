"""Block adjustment: many images, adjusted together on tie points and control."""
