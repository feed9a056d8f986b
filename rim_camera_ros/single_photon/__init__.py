"""Arrays of single-photon avalanche diodes: direct time of flight by histograms of first photons."""
