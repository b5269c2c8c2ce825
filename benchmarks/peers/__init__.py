"""The other side of each comparison: equations and engines written on other libraries, as their users
would."""
