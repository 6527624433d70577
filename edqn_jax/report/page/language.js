// uPlot writes numbers in the browser's language, whose name may be none: Chromium in a POSIX locale has "en-US@posix".
try {
  new Intl.NumberFormat(navigator.language);
} catch {
  Object.defineProperty(navigator, "language", { value: "en-US" });
}
