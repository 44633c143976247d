//! Peaks and lags of sampled signals.
