"""What can be trained and can act, behind one interface (`interface.py`): 3DS-VLA and what it is compared with."""
