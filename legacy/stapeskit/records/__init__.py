"""What passes from room to room: mass and motion, each with reader, writer and checks."""
