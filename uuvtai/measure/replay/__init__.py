"""Recorded episodes fed to the pilot again: does it decide the same?"""
