"use strict";
// The page of a line: its drawings are there already, and tables sort themselves.
document.body.dataset.ready = "yes";
