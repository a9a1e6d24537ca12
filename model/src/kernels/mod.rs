//! Fast CPU kernels behind candle: tiled attention, linear layers with fused epilogues, layer norm.
