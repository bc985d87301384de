"""The process of the fusion center: order of reports, normalisation constants, LR, life of tracks."""
