//! Claims about the faces.
