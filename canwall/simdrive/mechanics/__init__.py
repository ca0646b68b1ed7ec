"""Motor, current loop, encoder, handle and hand, and the path of the torque to them."""
