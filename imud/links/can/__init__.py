"""CAN buses: native SocketCAN, and any other interface of python-can."""
