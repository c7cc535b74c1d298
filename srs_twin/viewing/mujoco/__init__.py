"""The twin as MuJoCo draws it: pictures, videos, and a window to steer it in."""
