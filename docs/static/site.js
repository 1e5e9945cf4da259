// Options are not broken at their hyphens, where a long command is wrapped.
document.addEventListener("DOMContentLoaded", () => {
  for (const block of document.querySelectorAll(".highlight-sh pre, .highlight-text pre")) {
    const walk = document.createTreeWalker(block, NodeFilter.SHOW_TEXT);
    const texts = [];
    while (walk.nextNode()) if (walk.currentNode.data.includes("-")) texts.push(walk.currentNode);
    for (const text of texts) {
      const parts = text.data.split(/(\s+)/).map((part) => {
        if (!part.includes("-")) return part;
        return Object.assign(document.createElement("span"), { className: "word", textContent: part });
      });
      text.replaceWith(...parts);
    }
  }
});
