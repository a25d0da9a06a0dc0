"""How close a generated video is to the recorded one."""
