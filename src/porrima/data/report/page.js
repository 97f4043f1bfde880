"use strict";
for (const button of document.querySelectorAll("button[data-copies]")) {
  const table = document.getElementById(button.dataset.copies);
  const said = document.getElementById("said");
  button.hidden = false;
  button.addEventListener("click", async () => {
    const lines = [...table.rows].map((row) => [...row.cells].map((cell) => cell.innerText.trim()).join("\t"));
    try {
      await navigator.clipboard.writeText(lines.join("\n"));
    } catch {
      const selection = getSelection();
      selection.selectAllChildren(table);
      document.execCommand("copy");
      selection.removeAllRanges();
    }
    said.textContent = button.getAttribute("aria-label").replace("Copy", "Copied");
  });
}
const scrollers = document.querySelectorAll(".scroll, .rows, .equation");
const reachable = () => {
  for (const box of scrollers) {
    if (box.scrollWidth > box.clientWidth || box.scrollHeight > box.clientHeight) box.tabIndex = 0;
    else box.removeAttribute("tabindex");
  }
};
reachable();
addEventListener("resize", reachable);
