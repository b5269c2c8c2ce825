"""Instruments of the field: one small file a device turns what it sends into messages of the pilot."""
