"""The mathematics: arrays in, arrays out, leading batch axes everywhere; no clock, no file, no log."""
