// Worker: a clock that a hidden tab does not slow down.

setInterval(() => postMessage(0), 100);
