//! Case study 2: human motion drives a dual-arm `YuMi`.
