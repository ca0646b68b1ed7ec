"""What turns: motor, current loop, encoder, handle and hand, and the way of the torque to them."""
