"""Files in which vehicles and instruments of others were recorded, as one log of ours."""
